"""The operator's keys and status rows while a robot records."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, override

from ibrobot_terminal.plural import counted, plural

from ibrobot_core.api import IbrobotError, NotSupported, OperatorEvent, ViewerDescriptor, seconds
from ibrobot_core.app import Event, RecordedRun, RunHooks
from ibrobot_data.cues import ENDING_S, Cues
from ibrobot_data.episode_service import RECORD, START, EpisodeService
from ibrobot_data.errors import DiskFull
from ibrobot_data.options import has_button
from ibrobot_data.recording_session import Session as SessionEvent
from ibrobot_data.written import lost_text, rows

if TYPE_CHECKING:
    from ibrobot_data.beside import ConversionBeside

_MIB = 1 << 20
_REDO_S = 8.0
"""How long a person can record the last episode again before the run ends [s]."""
_START, _FAILURE, _DISCARD, _REDO = "tab", "f11", "f12", "backspace"
"""The keys; `_START` also ends an episode as a success, and between episodes `_FAILURE` asks for another prompt. None
of them jogs the robot."""


class Operator(RunHooks):
    """Begins and ends episodes, and pauses between them, by the operator's keys or by the flags.

    Args:
        run: the run.
        service: begins and ends its episodes.
        count: number of episodes to record; None: until Ctrl-C.
        reset_time_s: pause after each episode to reset the scene [s].
        prompt: prompt of all episodes; None asks the operator, and Enter repeats the last one.
        auto: begin every episode automatically, and end it after the contract's `max_duration_s`. If the recorder
            fails, or the disk has no room for another episode, the run ends.
        continuous: one episode, from the first complete set of messages to the end of the run.
        keys: whether the run has a terminal for the operator's keys.
        cues: plays cues; by default none.
        beside: converts episodes that have ended; by default nothing does.
        report: receives the state of the session when it changes.

    Raises:
        NotSupported: with `continuous` if the mode begins and ends episodes itself, or if nothing can begin one.
    """

    def __init__(
        self, run: RecordedRun, service: EpisodeService, count: int | None, reset_time_s: float, prompt: str | None, *,
        auto: bool, keys: bool, continuous: bool = False, report: Callable[[Event], None] | None = None,
        cues: Cues | None = None, beside: ConversionBeside | None = None,
    ) -> None:  # fmt: skip
        if service.by_mode and continuous:
            raise NotSupported(f"--continuous: mode {run.mode} begins and ends its episodes itself")
        if not (service.by_mode or auto or continuous or keys or _can_begin(run)):
            raise NotSupported(
                f"nothing can begin an episode: there is no terminal for keys, no device of mode {run.mode} has a "
                f"button `start`, and no other program may call {START.name}; add --auto"
            )
        self._run = run
        self._service = service
        self._cues = cues or Cues("none", None)
        service.on_cue.append(self._cues.play)
        self._beside = beside
        self._warned_of = 0
        """Number of the episode whose end was announced."""
        self._count = service.wanted = count
        self._keys = keys
        self._reset_time_s = reset_time_s
        self._prompt = prompt
        self._auto = auto or continuous
        self._continuous = continuous
        self._longest_s = inf if continuous else run.config.contract.max_duration_s
        self._not_before_s = 0.0
        self._complete_s: float | None = None
        """Since when all episodes are saved [s]; None while some are not."""
        self._typed: str | None = None
        """The typed part of a prompt; None while none is asked for."""
        self._asked = False
        """Whether the operator has given a prompt, which then holds for the next episodes, too."""
        self._complaint = ""
        self._report = report
        self._reported: Event | None = None

    def _clock_s(self) -> float:
        return seconds(self._run.clock.now_ns())

    @override
    def step(self) -> None:
        """Begin or end an episode when it is due; called a few times a second."""
        self._tell()
        self._cues.step()
        if self._beside is not None:
            self._beside.step()
        while not self._run.operator_events.empty():
            self._press(self._run.operator_events.get())
        if self._service.by_mode:
            return
        if self._service.running or self._service.waiting:
            self._complete_s = None
        if self._service.running:
            self._record()
        else:
            self._pause()

    def _record(self) -> None:
        """End the present episode when it is due."""
        service = self._service
        left_s = self._longest_s - service.elapsed_s()
        if left_s <= ENDING_S < self._longest_s and service.number != self._warned_of:
            self._warned_of = service.number
            service.play("ending")
        if service.failure is not None:
            self._end(lambda: service.stop("unknown"))
            self._refuse(f"recording ended: {service.failure}")
            if self._auto:  # no operator can correct it
                self._run.finish()
        elif self._auto and service.faults:
            self._end(lambda: service.stop("failure"))
        elif left_s <= 0.0:
            self._run.log.info("the episode is %g s long (contract.max_duration_s): ended", self._longest_s)
            self._end(lambda: service.stop("unknown"))

    def _pause(self) -> None:
        """Begin the next episode, or end the run, when it is due."""
        if self._service.waiting:
            self._try(self._service.follow)
        elif self._count is not None and self._service.saved - self._spoilt >= self._count:
            if self._complete_s is None:
                self._complete_s = self._clock_s()
            if self._is_over():
                self._run.finish()
        elif self._auto and self._clock_s() >= self._not_before_s:
            self._begin(self._prompt)

    def _is_over(self) -> bool:
        """Whether the last episode is written, its cue has ended, and so has the pause in which it can be redone."""
        heard = not (self._service.writing or self._cues.playing)
        return heard and (self._auto or (self._clock_s() >= self._not_before_s and self._redo_left_s() <= 0))

    def _redo_left_s(self) -> float:
        """Time in which a person can record the last of all episodes again [s]; 0 without a person."""
        if self._complete_s is None or self._auto or not (self._keys or self._run.config.viewer is not None):
            return 0.0
        return self._complete_s + _REDO_S - self._clock_s()

    @property
    def _spoilt(self) -> int:
        """Number of automatic episodes with a fault or emergency stop, which are repeated."""
        return self._run.outcome.disturbed if self._auto else 0

    @override
    def key(self, key: str) -> bool:
        """Act on a key; False if the key has no meaning here."""
        if self._service.by_mode or self._continuous:
            return False
        if self._typed is not None:
            self._type(key)
        elif key == _START and self._service.running:
            self._end(lambda: self._service.stop("success"))
        elif key in (_START, _DISCARD) and self._service.waiting:
            self._service.discard()
        elif key == _START and self._complete_s is not None:
            self._run.finish()
        elif key == _START and (self._prompt is not None or self._asked):
            self._begin(self._prompt)
        elif key == _START or (key == _FAILURE and self._prompt is None and not self._service.running):
            self._ask()
        elif key == _FAILURE and self._service.running:
            self._end(lambda: self._service.stop("failure"))
        elif key == _DISCARD and self._service.running:
            self._end(self._service.discard)
        elif key == _REDO and self._service.can_redo:
            self._try(self._service.redo)
        else:
            return False
        return True

    def _press(self, event: OperatorEvent) -> None:
        """Act on a button of a teleoperation device. It begins an episode with the last prompt."""
        service = self._service
        if service.by_mode or self._continuous:
            self._run.log.warning("%s: this run begins and ends its episodes automatically", event)
        elif event == "start":
            self._begin(self._prompt, wait=False)
        elif not service.running:
            self._refuse(f"{event}: no episode is being recorded")
        elif event == "discard":
            self._end(service.discard)
        else:
            self._end(lambda: service.stop(event))

    @override
    def rows(self) -> list[tuple[str, str]]:
        """Heading and text, for the panel."""
        status = self._service.status()
        before = sum(sum(each.lost.values()) for each in self._service.written)
        earlier = f"; {before} in earlier episodes of this run" if before else ""
        rates = "  ".join(f"{topic} {rate:g} Hz" for topic, rate in status.rates_hz.items())
        return [  # a small terminal leaves out the end
            ("record", self._state()),
            *([("", self._complaint)] if self._complaint else []),
            ("saved", f"{self._saved()} into {self._service.folder}"),
            *([("dataset", self._beside.row())] if self._beside is not None else []),
            ("lost", f"{lost_text(status.lost) if status.lost else 'nothing'}{earlier}"),
            (
                "disk",
                f"{status.free_bytes // _MIB} MiB left at {status.bytes_per_s / _MIB:.1f} MiB/s, "
                f"{status.waiting_bytes / _MIB:.1f} MiB queued",
            ),
            ("topics", rates or "none yet"),
        ]

    @override
    def line(self) -> str:
        """One line, where there is no panel."""
        lost = sum(self._service.status().lost.values())
        return f"{self._state()}, saved {self._saved()}{f', lost {counted(lost, "message")}' if lost else ''}"

    @override
    def help(self) -> str:
        """The keys."""
        if self._service.by_mode or self._continuous:
            return ""
        service = self._service
        again = ["Backspace again"] if service.can_redo else []
        if service.running:
            return "   ".join(["Tab success", "F11 failure", "F12 discard", *again])
        if service.waiting:
            return "Tab goes back"
        if self._complete_s is not None:
            return "   ".join(["Tab end of the session", *again])
        other = ["F11 another task"] if self._prompt is None and self._asked else []
        return "   ".join(["Tab start", *other, *again])

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        """Rows for the summary of the run."""
        self._tell(ended=True)
        episodes = plural(self._service.saved if self._count is None else self._count, "episode")
        return [("recorded", f"{self._saved()} {episodes} into {self._service.folder}"), *rows(self._service.written)]

    def _state(self) -> str:
        service = self._service
        if self._typed is not None:
            enter = f"takes “{service.last_prompt}”" if service.last_prompt else "leaves it empty"
            return f"prompt (Enter alone {enter}, Tab goes back): {self._typed}_"
        if service.running:
            prompt = f" “{service.last_prompt}”" if service.last_prompt else ""
            left = "" if self._continuous else f", {max(0.0, self._longest_s - service.elapsed_s()):.0f} s left"
            return f"recording{prompt}, {service.elapsed_s():.0f} s{left}"
        if service.waiting:
            return "ready: recording begins when the robot follows you"
        if self._service.writing and self._service.status().waiting_bytes >= _MIB:
            return f"writing the last episode, {self._service.status().waiting_bytes / _MIB:.0f} MiB are left"
        return self._state_of_pause()

    def _state_of_pause(self) -> str:
        if self._complete_s is not None:
            return f"all episodes are saved; the session ends in {max(0.0, self._redo_left_s()):.0f} s"
        if (pause_s := self._not_before_s - self._clock_s()) > 0:
            return f"reset the scene, {pause_s:.0f} s"
        return "waiting: Tab starts" if self._keys and not (self._auto or self._service.by_mode) else "waiting"

    def _tell(self, *, ended: bool = False) -> None:
        """Report the state of the session, if it has changed."""
        if self._report is None:
            return
        folder, state = str(self._service.folder), "ended" if ended else self._state()
        event = SessionEvent(folder=folder, saved=self._service.saved, wanted=self._count, state=state)
        if event != self._reported:
            self._report(event)
        self._reported = event

    def _saved(self) -> str:
        saved = self._service.saved
        return f"{saved} of {self._count}" if self._count is not None else str(saved)

    def _ask(self) -> None:
        # Letters of the prompt must not jog the arm.
        self._run.end_source()
        self._typed = ""

    def _type(self, key: str) -> None:
        assert self._typed is not None
        if key == "enter":
            typed, self._typed = self._typed, None
            self._asked = True
            self._run.begin_source()
            self._begin(typed or None)
        elif key == _START:
            self._typed = None
            self._run.begin_source()
        elif key == "backspace":
            self._typed = self._typed[:-1]
        elif key == "space":
            self._typed += " "
        elif len(key) == 1:
            self._typed += key

    def _begin(self, prompt: str | None, *, wait: bool = True) -> None:
        """Begin an episode; with `wait`, once the robot follows the operator."""
        if self._clock_s() < self._not_before_s:
            self._not_before_s = 0.0  # the operator is ready sooner
        self._try(lambda: self._service.start(prompt, wait=wait and not self._continuous))

    def _try(self, act: Callable[[], None]) -> None:
        """Do what begins an episode; show why it does not."""
        try:
            act()
        except IbrobotError as error:
            if str(error) != self._complaint:
                self._run.log.error("%s", error)
            self._refuse(str(error))
            if self._auto and isinstance(error, DiskFull):
                self._run.add_fault(str(error))
                self._run.finish()
        else:
            self._complaint = ""

    def _refuse(self, why: str) -> None:
        self._complaint = why
        if self._auto:  # retry after a pause: the cause rarely disappears at once
            self._not_before_s = max(self._not_before_s, self._clock_s() + 1.0)

    def _end(self, act: Callable[[], None]) -> None:
        act()
        self._not_before_s = self._clock_s() + self._reset_time_s


def _can_begin(run: RecordedRun) -> bool:
    """Whether the viewer, a teleoperation device of the mode, or another program can begin episodes."""
    if (viewer := run.config.viewer) is not None:
        shown_by = run.registry.find("viewer", viewer.type)
        assert isinstance(shown_by, ViewerDescriptor)
        if shown_by.begins_episodes:
            return True
    doors = [section.options for section in run.config.plugin_sections.values()]
    if run.config.transport is not None:
        doors.append(run.config.transport.options)
    if any(door.offers(service.name) for door in doors for service in (START, RECORD)):
        return True
    return has_button(run, run.config.control_modes[run.mode].devices.values(), "start")
