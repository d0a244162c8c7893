"""`ibrobot record`: run a robot and record its episodes, by keys or unattended."""

from __future__ import annotations

import sys
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import Any, override

import click

from ibrobot_core.cli.launch import Watcher, launch_options, run_robot
from ibrobot_core.errors import DiskFull, IbrobotError
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.recording.desk import EpisodeDesk
from ibrobot_core.units import plural, seconds

_MIB = 1 << 20
_START, _FAILURE, _DISCARD = "tab", "f11", "f12"
"""The keys; `_START` also ends an episode as a success. None is one that a person jogs with."""


class Operator(Watcher):
    """What the operator does, or in a run without one the flags: begins episodes, ends them, pauses between them.

    Args:
        count: episodes to record; None: until Ctrl-C.
        reset_time_s: pause after an episode, for setting the scene up anew [s].
        prompt: of all episodes; None asks for it, with Enter for the last one.
        auto: begin every episode by itself, and end it after the contract's `max_duration_s`. Where the recorder
            fails, or the disk has no room for another one, the run ends.
        continuous: one episode, from when everything is there to the end of the run.
        keys: whether there is a terminal whose keys the operator presses.
    """

    def __init__(
        self, count: int | None, reset_time_s: float, prompt: str | None, *, auto: bool, keys: bool,
        continuous: bool = False,
    ) -> None:  # fmt: skip
        self._count = count
        self._reset_time_s = reset_time_s
        self._prompt = prompt
        self._auto = auto or continuous
        self._continuous = continuous
        self._keys = keys
        self._not_before_s = 0.0
        self._typed: str | None = None
        """What is typed of a prompt; None while nothing is asked."""
        self._complaint = ""

    @override
    def attach(self, runtime: Runtime) -> None:
        """Watch over a run that records."""
        assert runtime.desk is not None
        self._runtime = runtime
        self._desk: EpisodeDesk = runtime.desk
        self._longest_s = inf if self._continuous else runtime.session.config.contract.max_duration_s
        self._by_mode = runtime.plan.episodes_worker is not None
        if self._by_mode and self._continuous:
            raise click.UsageError(f"--continuous: mode {runtime.session.mode} begins and ends its episodes itself")
        if not (self._by_mode or self._auto or self._keys):
            raise click.UsageError("without a terminal nobody can begin an episode: add --auto")

    def _clock_s(self) -> float:
        return seconds(self._runtime.session.clock.now_ns())

    @override
    def step(self) -> None:
        """Do what is due; called a few times a second."""
        if self._by_mode:
            return
        desk = self._desk
        if desk.recording:
            if desk.failure is not None:
                self._end(lambda: desk.stop("unknown"))
                self._refuse(f"recording ended: {desk.failure}")
                if self._auto:  # nobody is there to put it right
                    self._runtime.session.finish()
            elif desk.elapsed_s() >= self._longest_s:
                log = self._runtime.session.log
                log.info("the episode is %g s long (contract.max_duration_s): ended", self._longest_s)
                self._end(lambda: desk.stop("unknown"))
        elif self._count is not None and desk.saved >= self._count:
            self._runtime.session.finish()
        elif self._auto and self._clock_s() >= self._not_before_s:
            self._begin(self._prompt)

    @override
    def key(self, key: str) -> bool:
        """Obey a key; False for one that means nothing here."""
        if self._by_mode or self._continuous:
            return False
        if self._typed is not None:
            self._type(key)
        elif key == _START and self._desk.recording:
            self._end(lambda: self._desk.stop("success"))
        elif key == _START:
            self._ask()
        elif key == _FAILURE and self._desk.recording:
            self._end(lambda: self._desk.stop("failure"))
        elif key == _DISCARD and self._desk.recording:
            self._end(self._desk.discard)
        else:
            return False
        return True

    @override
    def rows(self) -> list[tuple[str, str]]:
        """Heading and text, for the panel."""
        status = self._desk.status()
        lost = sum(status["lost"].values())
        rates = "  ".join(f"{topic} {rate:g} Hz" for topic, rate in status["rates_hz"].items())
        rows = [
            ("record", self._state()),
            ("saved", f"{self._saved()} into {self._desk.folder}"),
            ("topics", rates or "none yet"),
            ("lost", f"{lost} messages"),
            (
                "disk",
                f"{status['free_bytes'] // _MIB} MiB left at {status['bytes_per_s'] / _MIB:.1f} MiB/s, "
                f"{status['waiting_bytes'] / _MIB:.1f} MiB wait for it",
            ),
        ]
        if self._complaint:
            rows.append(("", self._complaint))
        return rows

    @override
    def line(self) -> str:
        """One line, where there is no panel."""
        return f"{self._state()}, saved {self._saved()}"

    @override
    def help(self) -> str:
        """The keys."""
        if self._by_mode or self._continuous:
            return ""
        return "Tab start, and end as success   F11 end as failure   F12 discard"

    @override
    def told(self) -> list[tuple[str, str]]:
        """For the summary of the run."""
        episodes = plural(self._desk.saved if self._count is None else self._count, "episode")
        return [("recorded", f"{self._saved()} {episodes} into {self._desk.folder}")]

    def _state(self) -> str:
        desk = self._desk
        if self._typed is not None:
            enter = f"takes “{desk.last_prompt}”" if desk.last_prompt else "leaves it empty"
            return f"prompt (Enter alone {enter}, Tab goes back): {self._typed}_"
        if desk.recording:
            prompt = f" “{desk.last_prompt}”" if desk.last_prompt else ""
            left = "" if self._continuous else f", {max(0.0, self._longest_s - desk.elapsed_s()):.0f} s left"
            return f"recording{prompt}, {desk.elapsed_s():.0f} s{left}"
        pause_s = self._not_before_s - self._clock_s()
        if pause_s > 0:
            return f"set the scene up anew, {pause_s:.0f} s"
        return "waiting" if self._auto or self._by_mode else "waiting: Tab starts"

    def _saved(self) -> str:
        saved = self._desk.saved
        return f"{saved} of {self._count}" if self._count is not None else str(saved)

    def _ask(self) -> None:
        if self._prompt is not None:
            self._begin(self._prompt)
            return
        # Letters of the prompt must not jog the arm.
        feeder = self._runtime.session.feeder
        if feeder is not None:
            feeder.end()
        self._typed = ""

    def _type(self, key: str) -> None:
        assert self._typed is not None
        if key == "enter":
            typed, self._typed = self._typed, None
            self._resume()
            self._begin(typed or None)
        elif key == _START:
            self._typed = None
            self._resume()
        elif key == "backspace":
            self._typed = self._typed[:-1]
        elif key == "space":
            self._typed += " "
        elif len(key) == 1:
            self._typed += key

    def _resume(self) -> None:
        self._runtime.session.feed()

    def _begin(self, prompt: str | None) -> None:
        if self._clock_s() < self._not_before_s:
            self._not_before_s = 0.0  # the operator is ready sooner
        try:
            self._desk.start(prompt)
        except IbrobotError as error:
            if str(error) != self._complaint:
                self._runtime.session.log.error("%s", error)
            self._refuse(str(error))
            if self._auto and isinstance(error, DiskFull):
                self._runtime.session.add_fault(str(error))
                self._runtime.session.finish()
        else:
            self._complaint = ""

    def _refuse(self, why: str) -> None:
        self._complaint = why
        if self._auto:  # what keeps an episode from being recorded rarely passes at once
            self._not_before_s = max(self._not_before_s, self._clock_s() + 1.0)

    def _end(self, act: Callable[[], None]) -> None:
        act()
        self._not_before_s = self._clock_s() + self._reset_time_s


@click.command()
@launch_options
@click.option("--dataset", metavar="NAME", help="Folder of the episodes, below the root.")
@click.option("--root", type=click.Path(path_type=Path), help="Folder of all datasets.")
@click.option("--prompt", metavar="TEXT", help="What the task is called; asked for where it is left out.")
@click.option("--auto", is_flag=True, help="Begin episodes by itself; end them after contract.max_duration_s.")
@click.option("--continuous", is_flag=True, help="One episode, from the start of the run to its end.")
@click.option(
    "--reset-time", type=click.FloatRange(min=0), default=0.0, metavar="S", help="Pause between episodes [s]."
)
def record(config: str | None, dataset: str | None, root: Path | None, **options: Any) -> None:
    """Run a robot and record its episodes as bags.

    CONFIG is a robot YAML as for `ibrobot launch`; where it has no `recording` section, episodes go to
    episodes/default. In simulation a policy's episodes are recorded unattended, with the scene's own judgement. In all
    other modes keys begin and end them; without a terminal --auto does, or --continuous records without a break, in
    files as recording.split_size and recording.split_duration say.

    Exits as `ibrobot launch` does.
    """
    prompt, auto, reset_time = options.pop("prompt"), options.pop("auto"), options.pop("reset_time")
    continuous = options.pop("continuous")
    if continuous and (auto or options["episodes"] is not None or reset_time):
        raise click.UsageError("--continuous records one episode: leave --auto, --episodes and --reset-time out")
    overrides = tuple(f"recording.{key}={value}" for key, value in (("dataset", dataset), ("root", root)) if value)
    live = sys.stdin.isatty() and sys.stdout.isatty() and not options["headless"]
    operator = Operator(options["episodes"], reset_time, prompt, auto=auto, keys=live, continuous=continuous)
    run_robot(config, options, watcher=operator, recording=overrides, prompt=prompt or "")
