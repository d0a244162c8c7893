"""The cause `to_and_fro`."""

from __future__ import annotations

from typing import override

import numpy as np
from ibrobot_diagnose.cause import Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.window import Window

_USUAL, _CERTAIN = 4.0, 8.0
"""Turns per second above which the cause is named, and with which it is certain."""


class ToAndFro(Cause):
    """A joint is commanded to turn around several times per second."""

    name = "to_and_fro"
    title = "no joint is commanded to and fro"
    needs = frozenset({"commands"})
    remedy = "Look at what commands the joint: a device may be noisy, or a policy undecided between two ways."

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        commands = window.commands[np.isfinite(window.commands).all(axis=1)]
        if len(commands) < 3 or not window.seconds:
            return None
        steps = np.diff(commands, axis=0)
        turns = steps[1:] * steps[:-1] < 0
        rates = turns.sum(axis=0) / window.seconds
        worst = int(np.argmax(rates))
        rate = float(rates[worst])
        text = f"{window.joints[worst]} was commanded to turn around {rate:.1f} times per second."
        since_s = float(np.argmax(turns[:, worst])) / window.contract.rate_hz
        return Evidence(text, rate, "1/s", _USUAL, likelihood(rate, _USUAL, _CERTAIN), since_s=since_s)
