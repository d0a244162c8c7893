"""`ibrobot identify`."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import attrs
from ibrobot_calibration import load_calibration
from ibrobot_calibration.joint_units import with_closed_ends
from ibrobot_provenance.robot_metadata import robot_metadata

from ibrobot_core.api import Contract, RecorderError
from ibrobot_core.app import (
    Emit,
    Override,
    RequestError,
    RobotConfig,
    dump_yaml,
    echo,
    find_config,
    from_document,
    installed_plugins,
    load_config,
    wrong_input,
)
from ibrobot_mujoco.identification.contents import PARAMETERS, write_report
from ibrobot_mujoco.identification.excitation import excitation, plainly
from ibrobot_mujoco.identification.options import Excited, IdentifyOptions, IdentifyProgress, IdentifyReport
from ibrobot_mujoco.identification.recordings import Recording, find_recordings, read_recordings
from ibrobot_mujoco.options import MujocoOptions
from ibrobot_mujoco.parameters import read_parameters


@attrs.frozen(kw_only=True)
class Identify(IdentifyOptions):
    """Find the parameters of a simulated arm from EPISODES, recordings of the real one.

    Delay, gains, friction, inertia of the rotors, backlash and the rest follow from commands and measured positions
    alone. Each has its standard deviation; part of the recordings is held out, and the errors of the simulated arm on
    it are measured before and after. Names weak joints, backlash and what has changed since the last time, and what
    the recordings could not tell. The file of parameters is for `simulation.parameters` of the robot YAML.

    --excite ROBOT moves an arm so that its recording tells most: free space around it is needed.
    """

    @wrong_input()
    def __call__(self, emit: Emit) -> dict[str, Any] | None:
        if (self.excite is None) == (not self.episodes):
            raise RequestError("give recordings to identify from, or a robot that makes one with --excite")
        if self.excite is not None:
            folder = self._excite(self.excite)
            if emit is not None:
                emit(Excited(dataset=str(folder)))
            return None
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise RequestError(f"--out {self.out}: is a file; name a folder")

        def tell(what: str, share: float) -> None:
            if emit is not None:
                emit(IdentifyProgress(what=what, share=share))

        last = read_parameters(self.last) if self.last is not None else None
        config, recordings = self._read(tell)
        assert config.simulation is not None
        options = config.simulation.options
        if not isinstance(options, MujocoOptions):
            raise RequestError(f"{config.source}: simulation.type is {config.simulation.type}; identify needs mujoco")
        if last is None and options.parameters is not None:
            last = read_parameters(options.parameters)
        from ibrobot_mujoco.identification.identify import identify  # late: it imports SciPy and MuJoCo

        result = identify(options, config.robot, recordings, last, self.rotations, tell)
        facts = result.facts()
        if self.out is not None:
            write_report(self.out, facts, result.parameters)
        if emit is not None:
            emit(IdentifyReport(out=str(self.out or ""), lines=tuple(facts["lines"])))
            return None
        return facts

    def show(self, facts: dict[str, Any]) -> None:
        """Print the result."""
        for line in facts["lines"]:
            echo(line)
        echo("")
        for each in facts["parameters"]:
            echo(
                f"{each['joint']:14} {each['name']:21} {each['value']:9.4g} ± {each['deviation']:<8.2g} "
                f"{each['unit']:9} {each['confidence']}"
            )
        if self.out is not None:
            echo(f"report: {self.out / 'report.html'}")
            echo(f"use it: simulation: {{parameters: {self.out / PARAMETERS}}}")

    def _read(self, tell: Callable[[str, float], None]) -> tuple[RobotConfig, list[Recording]]:
        """The robot, and its recordings."""
        paths = find_recordings(self.episodes)
        config = _named(self.robot, self._changes) if self.robot is not None else None
        given = self._given(config)
        if config is None:
            config = _recorded(paths[0], self._changes)
        recordings = []
        for number, path in enumerate(paths):
            tell(f"reads {path.name}", 0.02 * number / len(paths))
            recordings += read_recordings(path, config.robot, given)
        return config, recordings

    def _given(self, config: RobotConfig | None) -> dict[str, str] | None:
        """What a dataset of another program does not say."""
        if self.norm_mode is None:
            if self.calibration is not None:
                raise RequestError("--calibration needs --norm-mode, the unit of the dataset")
            return None
        if config is None:
            raise RequestError("--norm-mode needs --robot, the robot YAML of the arm that was recorded")
        numbers = load_calibration(self.calibration).snapshot() if self.calibration is not None else None
        calibrations = {"given": with_closed_ends(numbers, config)} if numbers is not None else {}
        document = json.loads(json.dumps(config.document, default=str))
        contract = Contract.from_config(config).without_signals()
        return robot_metadata(contract, document, calibrations) | {"norm_mode": self.norm_mode}

    @property
    def _changes(self) -> tuple[str, ...]:
        """The overrides of the robot YAML, which may be options of a viewer."""
        return (*([f"viewer.type={self.viewer}"] if self.viewer is not None else []), *self.overrides)

    def _excite(self, robot: str) -> Path:
        """Move the robot, and record it; returns the folder of the dataset.

        Raises:
            SystemExit: if the motion is not done.
        """
        registry = installed_plugins()
        path = find_config(robot, registry)
        config = load_config(path, overrides=self._changes, sim=self.sim)
        made = () if config.recording is not None else (
            f"recording={{type: {registry.default('recorder')}, root: episodes, topics: contract}}",
        )  # fmt: skip
        named = Override.of(f"--dataset {self.dataset}", f"recording.dataset={json.dumps(self.dataset)}")
        task = excitation(config, self.minutes, self.seed)
        run = registry.command("task run").options
        with tempfile.TemporaryDirectory(prefix="ibrobot-excitation-") as folder:
            file = Path(folder) / "excitation.yaml"
            file.write_text(dump_yaml(task), encoding="utf-8")
            changes = (*made, *plainly(config), *self.overrides, named)
            perform = run(
                file=str(file), config=str(path), sim=self.sim, lockstep=self.lockstep, headless=self.headless,
                viewer=self.viewer, overrides=changes,
            )  # fmt: skip
            try:
                perform()
            except SystemExit as end:
                if end.code:
                    raise
        recording = load_config(path, overrides=(*self._changes, *made, named), sim=self.sim).recording
        assert recording is not None
        return recording.folder


def _named(name: str, overrides: tuple[str, ...]) -> RobotConfig:
    return load_config(find_config(name, installed_plugins()), overrides=overrides, sim=True)


def _recorded(path: Path, overrides: tuple[str, ...]) -> RobotConfig:
    """The robot of a recording."""
    with closing(installed_plugins().open_episode(path)) as reader:
        text = reader.summary().metadata.get("config")
    if text is None:
        raise RecorderError(f"{path}: has no robot YAML; name one with --robot")
    try:
        document = json.loads(text)
    except ValueError as error:
        raise RecorderError(f"{path}: its robot YAML cannot be read: {error}; name one with --robot") from None
    return from_document(document, source=Path("recorded config"), sim=True, overrides=overrides)
