"""Check that a restarted model has the same weights."""

from __future__ import annotations

import logging

from ibrobot_core.api import PolicyError


def check_weights(before: str, now: str, whose: str, *, accept: bool) -> None:
    """Compare the weights of a restarted model to the weights before.

    Args:
        before: hash of the previous weights; empty at the first start.
        now: hash of the new weights; empty if unknown.
        whose: name of the model, for the message.
        accept: whether to log a warning and use different weights, instead of raising.

    Raises:
        PolicyError: if the weights differ and `accept` is False.
    """
    if before in ("", now):
        return
    change = f"{whose} restarted with different weights: hash {now or 'unknown'}, previously {before}"
    if not accept:
        raise PolicyError(f"{change}; start the run again, or set inference.accept_new_weights: true")
    logging.getLogger("ibrobot.inference").warning("%s; the new weights are used from now on", change)
