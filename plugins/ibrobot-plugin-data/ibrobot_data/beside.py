"""Conversion beside a recording: episodes are converted one by one while the session runs, each in its own process.

The process keeps the converted episode where an interrupted conversion would, so that `ibrobot convert` at the end of
the session only has to add them to the dataset. It starts while the episode is recorded, so that it is ready when the
episode has ended, and has the lowest priority. Once a recording has lost messages or waits for the disk, it also waits
while an episode is recorded.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.app import Channel, Child, ComponentFailed, read_options, run_child
from ibrobot_data.command import Convert, conversion_request
from ibrobot_data.episode import make_writer
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.plural import plural
from ibrobot_data.run import stage

_MODULE = "ibrobot_data.beside"
_END_S = 2.0
_GLANCE_S = 0.1
_PATIENCE_S = 6.0
"""How long the end of a session waits for a process of the lowest priority, which a busy machine starves [s]."""
_MUCH = 16 << 20
"""From this number of bytes that wait for the disk, a recording needs it alone [bytes]."""


class ConversionBeside:
    """Converts the episodes of a session while it runs.

    Args:
        options: those of the conversion at the end of the session.
        service: begins and ends the episodes.
        log: receives why an episode cannot be converted.
    """

    def __init__(self, options: Convert, service: EpisodeService, log: logging.Logger) -> None:
        self._options = options
        self._service = service
        self._log = log
        self._alone = False
        """Whether a recording has needed the machine alone; then the next ones get it, too."""
        self._child: Child | None = None
        """It converts `_episode`, or is ready for the next one."""
        self._episode: Path | None = None
        self._paused = False
        self._done: dict[Path, str] = {}
        """Episode -> why it is not converted; empty if it is."""

    def step(self) -> None:
        """Start, pause or end the conversion of an episode when it is due; called a few times a second."""
        service, replaced = self._service, self._service.replaced
        if self._child is not None and self._episode is not None:
            if self._episode == replaced:
                self._cancel()  # its recording, which nobody may own, is deleted once the new one is saved
            else:
                self._watch(self._child)
        busy = service.running or service.writing
        if busy and not self._alone:
            status = service.status()
            self._alone = bool(status.lost) or status.waiting_bytes >= _MUCH
        paused = busy and self._alone
        if self._episode is None and not paused:
            outcomes = self._options.outcome
            todo = (
                each.path for each in service.written
                if each.whole and each.outcome in outcomes and each.path not in (*self._done, replaced)
            )  # fmt: skip
            episode = next(todo, None)
            if self._child is None and (episode is not None or service.running):
                self._child, self._paused = Child(_MODULE, {"options": _plain(self._options)}, end_s=_END_S), False
            if self._child is not None and episode is not None:
                self._episode = episode
                self._child.channel.send({"episode": str(episode)})
        if self._child is not None and paused != self._paused:
            self._paused = paused
            self._child.channel.send({"paused": paused})

    def finish(self) -> None:
        """Wait until the present episode is converted, once the session has ended; not for long on a busy machine."""
        until_s = time.monotonic() + _PATIENCE_S
        try:
            while (child := self._child) is not None and self._episode is not None and time.monotonic() < until_s:
                if self._paused:
                    self._paused = False
                    child.channel.send({"paused": False})
                self._watch(child, _GLANCE_S)
        finally:
            self._cancel()  # the conversion at the end converts what is left, at an ordinary priority

    def row(self) -> str:
        """What is done, for the panel."""
        done = sum(not why for why in self._done.values())
        now = "" if self._episode is None else f"; {self._episode.name} {'waits' if self._paused else 'follows'}"
        return f"{done} {plural(done, 'episode')} converted for {self._options.out}{now}"

    def _watch(self, child: Child, timeout_s: float = 0.0) -> None:
        """Note what the child says about its episode, and its end."""
        assert self._episode is not None
        try:
            if (message := child.wait(timeout_s)) is None:
                return
            why = str(message["error"])
        except ComponentFailed as error:
            why = str(error)
        if why:
            self._log.warning("%s is not converted beside the recording: %s", self._episode.name, why)
        self._done[self._episode] = why
        self._cancel()

    def _cancel(self) -> None:
        """End the child; what it has not finished is lost."""
        child, self._child, self._episode = self._child, None, None
        if child is not None:
            child.kill()
            child.end()
            child.channel.close()


def _plain(options: Convert) -> dict[str, Any]:
    """The options as JSON values."""
    given = {name: value for name, value in attrs.asdict(options, recurse=False).items() if value is not None}
    plain: dict[str, Any] = json.loads(json.dumps(given, default=str))
    return plain


def gate(channel: Channel, *, paused: bool = False) -> Callable[[int], None]:
    """A function to call after each frame: it waits as long as the session asks for it.

    Args:
        channel: to the session.
        paused: whether the session has asked for it already.

    Raises:
        ComponentFailed: by that function, if the session has died.
    """

    def wait(frames: int) -> None:
        nonlocal paused
        messages = channel.receive()
        while not channel.closed:
            for message in messages:
                paused = message["paused"]
            if not paused:
                return
            messages = channel.receive(None)
        raise ComponentFailed("the session has ended")

    return wait


def run(channel: Channel, order: Mapping[str, Any]) -> None:
    """The process: make ready, then convert the episode that the session names.

    Raises:
        IbrobotError: if nothing can be converted into this dataset.
    """
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    os.nice(19)
    options = read_options(Convert, order["options"], Path, {})
    make_writer(conversion_request(options))  # imports most of what a conversion needs
    paused = False
    while (message := channel.next(None)) is not None:
        if "episode" in message:
            episode = Path(message["episode"])
            request = conversion_request(attrs.evolve(options, episodes=(episode,)))
            report = stage(request, episode, gate(channel, paused=paused))
            channel.send({"error": report.error if report is not None else ""})
            return
        paused = message["paused"]


if __name__ == "__main__":
    sys.exit(run_child(run))
