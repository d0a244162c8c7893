"""Conversion beside a recording: each episode is converted while it is recorded, in a process of its own.

The process follows the recording as it reaches the disk, and keeps the converted episode where an interrupted
conversion would, so that `ibrobot convert` at the end of the session only has to add it to the dataset. It has the
lowest priority. Once a recording has lost messages or waits for the disk, episodes are converted between recordings.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.app import Channel, Child, ComponentFailed, read_options, run_child
from ibrobot_data.command import Convert, conversion_request
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.run import follow, stage
from ibrobot_data.written import WrittenEpisode

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
        self._episode = Path()
        """The one that the child converts."""
        self._growing = False
        """Whether it is still being recorded."""
        self._paused = False
        self._done: dict[Path, str] = {}
        """Episode -> why it is not converted; empty if it is."""

    def step(self) -> None:
        """Start, pause or end the conversion of an episode when it is due; called a few times a second."""
        service, replaced = self._service, self._service.replaced
        if self._child is not None:
            if self._episode == replaced:
                self._cancel()  # its recording, which nobody may own, is deleted once the new one is saved
            else:
                self._watch(self._child)
        busy = service.running or service.writing
        if busy and not self._alone:
            status = service.status()
            self._alone = bool(status.lost) or status.waiting_bytes >= _MUCH
        paused = busy and self._alone
        if self._child is not None and self._growing:
            self._look_for_end(self._child)
        if self._child is None and not paused:
            todo = [each.path for each in service.written if self._wants(each) and each.path not in self._done]
            if episode := next((path for path in todo if path != replaced), None):
                self._start(episode)
            elif service.running and (present := service.present) is not None and present not in self._done:
                self._start(present, growing=True)
        if self._child is not None and paused != self._paused:
            self._paused = paused
            self._child.channel.send({"paused": paused})

    def _look_for_end(self, child: Child) -> None:
        """Tell the child that the recording of its episode has ended, or end it if the episode is not wanted."""
        written = next((each for each in self._service.written if each.path == self._episode), None)
        if written is not None and self._wants(written):
            self._growing = False
            child.channel.send({"ended": True})
        elif written is not None or self._service.present != self._episode:
            self._cancel()

    def _wants(self, episode: WrittenEpisode) -> bool:
        return episode.whole and episode.outcome in self._options.outcome

    def finish(self) -> None:
        """Wait until the present episode is converted, once the session has ended; not for long on a busy machine."""
        until_s = time.monotonic() + _PATIENCE_S
        try:
            while (child := self._child) is not None and time.monotonic() < until_s:
                if self._growing:
                    self._look_for_end(child)
                if self._paused:
                    self._paused = False
                    child.channel.send({"paused": False})
                self._watch(child, _GLANCE_S)
        finally:
            self._cancel()  # the conversion at the end converts what is left, at an ordinary priority

    def row(self) -> str:
        """What is done, for the panel."""
        done = sum(not why for why in self._done.values())
        now = "" if self._child is None else f"; {self._episode.name} {'waits' if self._paused else 'follows'}"
        return f"{counted(done, 'episode')} converted for {self._options.out}{now}"

    def _start(self, episode: Path, *, growing: bool = False) -> None:
        options = attrs.evolve(self._options, episodes=(episode,))
        self._episode, self._growing, self._paused = episode, growing, False
        self._child = Child(_MODULE, {"options": _plain(options), "growing": growing}, end_s=_END_S)

    def _watch(self, child: Child, timeout_s: float = 0.0) -> None:
        """Note what the child says, and its end."""
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
        child, self._child = self._child, None
        if child is not None:
            child.kill()
            child.end()
            child.channel.close()


def _plain(options: Convert) -> dict[str, Any]:
    """The options as JSON values."""
    given = {name: value for name, value in attrs.asdict(options, recurse=False).items() if value is not None}
    plain: dict[str, Any] = json.loads(json.dumps(given, default=str))
    return plain


class Orders:
    """What the session asks for, by messages on a channel.

    Raises:
        ComponentFailed: by the methods, if the session has died.
    """

    def __init__(self, channel: Channel, *, growing: bool = False) -> None:
        self._channel = channel
        self._paused, self._ended = False, not growing

    def pass_on(self, frames: int) -> None:
        """Wait as long as the session asks for it; called after each frame."""
        self._take(0.0)

    def has_ended(self, timeout_s: float) -> bool:
        """Wait up to a time [s] for the end of the episode; returns whether it has ended."""
        if not self._ended:
            self._take(timeout_s)
        return self._ended

    def _take(self, timeout_s: float | None) -> None:
        while True:
            for message in self._channel.receive(timeout_s):
                self._paused = message.get("paused", self._paused)
                self._ended = message.get("ended", self._ended)
            if self._channel.closed:
                raise ComponentFailed("the session has ended")
            if not self._paused:
                return
            timeout_s = None


def run(channel: Channel, order: Mapping[str, Any]) -> None:
    """The process: convert one episode.

    Raises:
        IbrobotError: if nothing can be converted into this dataset.
    """
    if sys.platform == "linux":
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    os.nice(19)
    options = read_options(Convert, order["options"], Path, {})
    request, episode = conversion_request(options), options.episodes[0]
    orders = Orders(channel, growing=order["growing"])
    work = partial(follow, has_ended=orders.has_ended) if order["growing"] else stage
    report = work(request, episode, orders.pass_on)
    channel.send({"error": report.error if report is not None else ""})


if __name__ == "__main__":
    sys.exit(run_child(run))
