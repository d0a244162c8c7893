"""`ibrobot record`: run a robot and record its episodes, by keys or unattended."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import (
    Emit,
    LaunchRequest,
    ModeOptions,
    Override,
    RequestError,
    RobotConfig,
    Runtime,
    echo,
    installed_plugins,
    run_robot,
)
from ibrobot_data.cues import Cues
from ibrobot_data.episode_dataset import EpisodeDataset, count_complete
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.operator import Operator
from ibrobot_data.plural import plural
from ibrobot_data.prompt import check_prompt

CUES = ("beep", "speech", "none")
"""Kinds of cues; see `Cues`."""


@attrs.frozen(kw_only=True)
class Record(ModeOptions):
    """Run a robot and record its episodes as bags.

    CONFIG is a robot YAML as for `ibrobot launch`. If it has no `recording` section, episodes go to episodes/default.
    In simulation a policy's episodes begin and end by themselves, and the scene decides on success. In all other modes
    keys begin and end them, and so do the buttons of a teleoperation device. Without a terminal, use such a device,
    --auto, or --continuous for one episode without a break; recording.split_size and recording.split_duration divide
    it into files.

    Exits as `ibrobot launch` does.
    """

    prompt: str | None = option(
        None,
        validator=attrs.validators.optional(lambda _, __, prompt: check_prompt(prompt)),
        label="Task",
        help="description of the task, e.g. pick the cube; keys ask for it if left out",
    )
    dataset: str | None = option(None, label="Dataset", help="name of the dataset, a folder of episodes below the root")
    root: Path | None = option(None, label=None, help="folder of all datasets")
    episodes: int | None = option(
        None, ge=1, label="Episodes", help="number of episodes after which the session ends; without one, it goes on"
    )
    resume: bool = option(
        False,
        label="Go on",
        more=True,
        help="count the dataset's episodes of earlier runs, and keep their last prompt unless --prompt gives another",
    )
    cues: str = option(
        "beep",
        choices=CUES,
        label=None,
        help="what is heard when an episode begins, ends in three seconds, and is saved: bells of the terminal, or "
        "words by spd-say, say or espeak",
    )
    auto: bool = option(
        False,
        label="Automatic",
        more=True,
        help="begin episodes automatically; end them after contract.max_duration_s",
    )
    continuous: bool = option(
        False, label="Without a break", more=True, help="record one episode, from the start of the run to its end"
    )
    reset_time: float = option(0.0, ge=0, unit="s", label="Pause", more=True, help="pause between episodes")

    def __call__(self, emit: Emit) -> None:
        if self.continuous and (self.auto or self.episodes is not None or self.reset_time):
            raise RequestError("--continuous records one episode: leave --auto, --episodes and --reset-time out")
        robot = self._recorded()
        self.check_end(robot, self.episodes)
        assert robot.recording is not None
        folder, prompt, earlier = robot.recording.folder, self.prompt, 0
        if self.resume:
            earlier = count_complete(folder)
            prompt = prompt or EpisodeDataset(folder).prompt or None
        if self.episodes is not None and earlier >= self.episodes:
            echo(f"{folder}: has {earlier} {plural(earlier, 'episode')} already")
            return
        live = sys.stdin.isatty() and sys.stdout.isatty() and not self.headless
        cues = Cues(self.cues, sys.stdout.fileno() if live else None)

        def operator(runtime: Runtime) -> Operator:
            service = runtime.session.episodes
            assert isinstance(service, EpisodeService)
            service.earlier = earlier
            return Operator(
                runtime.session, service, self.episodes, self.reset_time, prompt, auto=self.auto,
                continuous=self.continuous, keys=live, report=emit,
                cues=cues,
            )  # fmt: skip

        request = LaunchRequest(
            self.lockstep, self.seed, self.duration, self.episodes and self.episodes - earlier, self.goals,
            prompt=prompt or "", by_operator=True,
        )  # fmt: skip
        run_robot(
            robot, request, headless=self.headless, dry_run=self.dry_run, as_json=self.as_json, make_hooks=operator
        )  # fmt: skip

    def _recorded(self) -> RobotConfig:
        """The robot of the YAML, with a section `recording` added if the YAML has none."""
        changes, made = self.changes(), []
        # An override within the section must not count as the section.
        robot = self.load(self.mode, [change for change in changes if not change.startswith("recording.")])
        if robot.recording is None:
            recorder = installed_plugins().default("recorder")
            made = [f"recording={{type: {recorder}, root: episodes, topics: contract}}"]
        named = [
            Override.of(f"--{key} {value}", f"recording.{key}={json.dumps(str(value))}")
            for key, value in (("dataset", self.dataset), ("root", self.root))
            if value is not None
        ]
        return self.load(self.mode, (*made, *changes, *named))
