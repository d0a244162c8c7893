"""Cues for an operator who looks at the robot, not at a screen: bells of the terminal, or spoken words."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
from collections import deque
from typing import Literal

from ibrobot_core.api import NotSupported

Cue = Literal["start", "ending", "saved"]
"""An episode begins; `ENDING_S` are left of it; it is saved."""
ENDING_S = 3.0
_BELLS: dict[Cue, int] = {"start": 1, "ending": 2, "saved": 3}
_WORDS: dict[Cue, str] = {"start": "recording", "ending": "three seconds", "saved": "saved"}
_SPEAKERS = ("spd-say", "say", "espeak-ng", "espeak")
"""Programs that speak their argument: of desktops, of macOS, and small ones."""


class Cues:
    """Plays cues one after another; `step` never waits.

    Args:
        kind: one of `CUES`, of the options.
        terminal: file descriptor of the terminal that rings; None without one, which then stays silent.

    Raises:
        NotSupported: for `speech` without a program that speaks.
    """

    def __init__(self, kind: str, terminal: int | None) -> None:
        self._terminal = terminal if kind == "beep" else None
        self._program = next(filter(None, map(shutil.which, _SPEAKERS)), None) if kind == "speech" else None
        if kind == "speech" and self._program is None:
            raise NotSupported(
                f"cues by speech: none of {', '.join(_SPEAKERS)} is installed; apt-get install speech-dispatcher, or "
                "leave the option out for bells of the terminal"
            )
        self._words: deque[str] = deque()
        self._bells = 0
        self._speaks: subprocess.Popen[bytes] | None = None

    def play(self, cue: Cue) -> None:
        """Play a cue after those before it."""
        if self._program is not None:
            self._words.append(_WORDS[cue])
        if self._terminal is not None:
            self._bells += _BELLS[cue]

    @property
    def playing(self) -> bool:
        """Whether a bell or word is under way or waits."""
        speaks = self._speaks is not None and self._speaks.poll() is None
        return speaks or bool(self._words or self._bells)

    def step(self) -> None:
        """Go on playing; called a few times a second, so that each bell is heard."""
        if self._bells and self._terminal is not None:
            if select.select([], [self._terminal], [], 0.0)[1]:
                self._bells -= 1
                os.write(self._terminal, b"\a")
            else:  # nobody reads it
                self._bells = 0
        if self._words and self._program is not None and (self._speaks is None or self._speaks.poll() is not None):
            command = [self._program, self._words.popleft()]
            quiet = subprocess.DEVNULL
            self._speaks = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet)
