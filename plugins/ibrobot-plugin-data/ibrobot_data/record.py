"""`ibrobot record`: run a robot and record its episodes, by keys or unattended."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_terminal.plural import counted

from ibrobot_core.api import option
from ibrobot_core.app import (
    Emit,
    LaunchRequest,
    ModeOptions,
    Override,
    RequestError,
    RobotConfig,
    Runtime,
    default_of,
    echo,
    fields,
    flag_of,
    installed_plugins,
    run_robot,
)
from ibrobot_data.conversion import ConvertOptions
from ibrobot_data.cues import Cues
from ibrobot_data.episode_dataset import EpisodeDataset, count_complete
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.operator import Operator
from ibrobot_data.prompt import check_prompt

if TYPE_CHECKING:
    from ibrobot_data.beside import ConversionBeside
    from ibrobot_data.command import Convert

CUES = ("beep", "speech", "none")
"""Kinds of cues; see `Cues`."""


_OF_CONVERSION = ("outcome", "only", "context", "missing", "norm_mode", "units", "success", "any_robot")
"""Options of `ibrobot convert` that this command has, too, as `--convert-OPTION`."""


def _with_conversion[C](kind: type[C]) -> type[C]:
    """Class decorator: add the options of the conversion."""
    for name in _OF_CONVERSION:
        known = attrs.fields_dict(ConvertOptions)[name]
        own = attrs.field(default=known.default, metadata={**known.metadata, "more": True}, validator=known.validator)
        setattr(kind, f"convert_{name}", own)
        kind.__annotations__[f"convert_{name}"] = known.type
    return kind


@attrs.frozen(kw_only=True)
@_with_conversion
class Record(ModeOptions):
    """Run a robot and record its episodes as bags.

    CONFIG is a robot YAML as for `ibrobot launch`. If it has no `recording` section, episodes go to episodes/default.
    In simulation a policy's episodes begin and end by themselves, and the scene decides on success. In all other modes
    keys begin and end them, and so do the buttons of a teleoperation device. Without a terminal, use such a device,
    --auto, or --continuous for one episode without a break; recording.split_size and recording.split_duration divide
    it into files.

    With --convert, episodes that have ended are converted while the session goes on, and added to the dataset when it
    ends, as `ibrobot convert --append` would. After an interruption, that command continues.

    Exits as `ibrobot launch` does; with --convert, with 1 if an episode cannot be converted.
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
    convert: bool = option(
        False, label="Convert", help="convert episodes beside the recording, so that the dataset is there at the end"
    )
    convert_out: Path | None = option(
        None, names="dataset", open=True, suggest="datasets/{dataset}", label="Converted into", more=True,
        help="folder of the converted dataset, to which episodes are added; by default datasets/DATASET",
    )  # fmt: skip
    convert_type: str | None = option(None, label=None, help="dataset writer; by default that of an installed plugin")
    convert_sets: tuple[str, ...] = option(
        (), typed="--convert-set OPTION=VALUE", label=None, help="any option of the dataset writer"
    )

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
        conversion = self._conversion(folder)
        if self.episodes is not None and earlier >= self.episodes:
            echo(f"{folder}: has {counted(earlier, 'episode')} already")
            if conversion is not None:
                conversion(emit)
            return
        live = sys.stdin.isatty() and sys.stdout.isatty() and not self.headless
        cues = Cues(self.cues, sys.stdout.fileno() if live else None)
        beside: list[ConversionBeside] = []

        def operator(runtime: Runtime) -> Operator:
            service = runtime.session.episodes
            assert isinstance(service, EpisodeService)
            service.earlier = earlier
            if conversion is not None:
                from ibrobot_data.beside import ConversionBeside

                beside.append(ConversionBeside(conversion, service, runtime.session.log))
            return Operator(
                runtime.session, service, self.episodes, self.reset_time, prompt, auto=self.auto,
                continuous=self.continuous, keys=live, report=emit,
                cues=cues, beside=beside[0] if beside else None,
            )  # fmt: skip

        request = LaunchRequest(
            self.lockstep, self.seed, self.duration, self.episodes and self.episodes - earlier, self.goals,
            prompt=prompt or "", by_operator=True,
        )  # fmt: skip
        try:
            run_robot(
                robot, request, headless=self.headless, dry_run=self.dry_run, as_json=self.as_json, make_hooks=operator
            )  # fmt: skip
        finally:
            if conversion is not None and beside:
                beside[0].finish()
                if count_complete(folder):
                    conversion(emit)

    def _conversion(self, folder: Path) -> Convert | None:
        """The conversion at the end of the session; None without `--convert`.

        Raises:
            RequestError: for options of it without `--convert`, or that do not fit.
        """
        known, values = fields(type(self)), attrs.asdict(self, recurse=False)
        given = {name: value for name, value in values.items() if name.startswith("convert_")}
        if not self.convert:
            for name, value in given.items():
                if value != default_of(known[name]):
                    raise RequestError(f"{flag_of(name, known[name])} needs --convert")
            return None
        from ibrobot_data.command import Convert, conversion_request
        from ibrobot_data.run import check_out

        out = self.convert_out or Path("datasets") / folder.name
        settings: dict[str, Any] = {name: given[f"convert_{name}"] for name in _OF_CONVERSION}
        conversion = Convert(
            episodes=(folder,), out=out, append=True, type_=self.convert_type, sets=self.convert_sets,
            as_json=self.as_json, **settings,
        )  # fmt: skip
        check_out(conversion_request(conversion))
        return conversion

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
