"""Whether a model that comes back is still the one that acted."""

from __future__ import annotations

import logging

from ibrobot_core.api import PolicyError


def check_weights(before: str, now: str, whose: str, *, accept: bool) -> None:
    """Compare the weights of a restarted model to the weights before.

    Args:
        before: hash of those that acted; empty at the first start.
        now: hash of those that would act.
        whose: which model, for the message.
        accept: whether others may act, with a warning.

    Raises:
        PolicyError: when they are others, and are not accepted.
    """
    if before in ("", now):
        return
    told = f"{whose} came back with other weights, {now or 'of no known hash'}; those that acted were {before}"
    if not accept:
        raise PolicyError(f"{told}; start the run again, or set inference.accept_new_weights: true")
    logging.getLogger("ibrobot.inference").warning("%s; they act from now on", told)
