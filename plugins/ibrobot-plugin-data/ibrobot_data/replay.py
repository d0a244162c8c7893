"""`ibrobot replay`: play the commands of a recorded episode on a robot, real or simulated."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path

import attrs
import numpy as np
from ibrobot_calibration import load_calibration

from ibrobot_core.api import Contract, ContractError, EpisodeSummary, RecorderError, Robot, ns, option
from ibrobot_core.app import (
    NORM_MODES,
    LaunchRequest,
    RequestError,
    RobotConfig,
    RunOptions,
    echo,
    find_config,
    from_document,
    installed_plugins,
    load_config,
    run_robot,
    wrong_input,
)
from ibrobot_data.config_metadata import metadata_from_config, with_anchored
from ibrobot_data.episode import recorded_contract
from ibrobot_data.playback import Playback, read_playback
from ibrobot_data.replay_source import ReplaySource
from ibrobot_data.same_robot import Identity
from ibrobot_data.stated import listed_joints, names_of, names_option

_FAR = 0.5
"""Maximum distance of a command from its limits, as a fraction of the joint's range; the safety layer clips it."""
_MODE = "replay"
"""The name of the mode in which an episode is replayed."""


@attrs.frozen(kw_only=True)
class Replay(RunOptions):
    """Play the commands of a recorded EPISODE, and compare the joints with the recorded ones.

    EPISODE is a folder such as episodes/pick/episodes/episode_000001, or DATASET:N, episode N from 0 of a dataset.
    CONFIG is a robot YAML as for `ibrobot launch`; by default the recorded one. The robot moves slowly to the first
    command, follows the commands at their times, within the limits of the safety layer, and stops. With --sim the
    recorded seed sets up the scene.

    Exits as `ibrobot launch` does; with 3 if the recorded episode succeeded in its scene and the replay does not.
    """

    episode: Path = option(typed="EPISODE", names="episodes", help="the episode")
    speed: float = option(1.0, typed="--speed X", gt=0, help="speed; 0.5 plays at half the recorded speed")
    force_contract: bool = option(False, help="replay even if the observations of CONFIG differ")
    any_robot: bool = option(False, help="replay even if robot, robot type or calibration differ")
    norm_mode: str | None = option(None, choices=NORM_MODES, help="unit of joints in a dataset that does not state it")
    calibration: str | None = option(
        None, typed="--calibration NAME", help="calibration for such a dataset, if its unit needs one"
    )
    anchored: str | None = option(
        None,
        typed="--anchored JOINT,…",
        help="with --calibration: joints that range from 0 to 100; by default those of the robot YAML's hardware",
    )

    names: tuple[str, ...] = names_option(
        "names of a feature's elements in their order, for a dataset that does not have them"
    )
    dry_run: bool = option(False, help="print the plan, compare model and contract; start nothing")

    def __call__(self) -> None:
        changes, sim = self.changes(), self.sim
        robot = _named(self.config, changes, sim=sim) if self.config is not None else None
        numbers = load_calibration(self.calibration).snapshot() if self.calibration is not None else None
        if self.anchored is not None and (robot is None or numbers is None):
            raise RequestError("--anchored needs --calibration and CONFIG, which has the joints' limits")
        if robot is not None and numbers is not None:
            with wrong_input():
                numbers = with_anchored(numbers, robot, listed_joints(self.anchored))
        given = (
            metadata_from_config(robot, self.norm_mode, numbers, names_of(self.names)) if robot is not None else None
        )
        with wrong_input(), closing(installed_plugins().open_episode(self.episode, given)) as reader:
            summary = reader.summary()
            robot = robot or _recorded(summary, changes, sim=sim)
            contract = Contract.from_config(robot)
            _check(contract, summary, str(robot.source), force=self.force_contract)
            if not self.any_robot:
                _check_robot(robot, summary)
            playback = read_playback(reader, contract, ns(1.0 / robot.control.rate_hz))
            _check_limits(playback, robot.robot, self.episode)
        if still := [joint for joint in contract.action_joints if joint not in playback.joints]:
            echo(f"{self.episode}: has no commands of {', '.join(still)}, which hold their positions", err=True)
        if not summary.finished:
            echo(f"{self.episode}: is unfinished; {playback.duration:.2f} s of it can be replayed", err=True)
        request = LaunchRequest(
            self.lockstep,
            playback.seed or 0,
            source=lambda session, mode: ReplaySource(session, mode, str(self.episode), playback, self.speed),
        )
        robot = _without_sensors(robot)
        run_robot(robot, request, headless=self.headless, dry_run=self.dry_run, as_json=self.as_json)


def _check_robot(robot: RobotConfig, summary: EpisodeSummary) -> None:
    """Check that the robot is the recorded one, as far as the episode identifies it."""
    recorded = Identity.of_episode(summary.metadata)
    if difference := Identity.of_robot(robot).difference(recorded, "this robot"):
        raise RecorderError(f"{summary.path}: {difference}; --any-robot replays it regardless")


def _check_limits(playback: Playback, robot: Robot, episode: Path) -> None:
    """Check that no command is far outside the limits, e.g. in a damaged file or in another unit."""
    columns = robot.indices(playback.joints)
    lower, upper = robot.lower[columns], robot.upper[columns]
    beyond = np.maximum(lower - playback.commands.positions, playback.commands.positions - upper)
    far = np.argwhere(beyond > _FAR * (upper - lower))
    for row, column in far[:1]:
        raise RecorderError(
            f"{episode}: {playback.joints[column]} is commanded to {playback.commands.positions[row, column]:.4g} rad "
            f"{playback.commands.times[row]:.2f} s after the first command, far outside its limits "
            f"{lower[column]:.4g} to {upper[column]:.4g} rad: the file is damaged, or its unit is not rad"
        )


def _without_sensors(robot: RobotConfig) -> RobotConfig:
    """The robot without cameras and other sensors, and without their observations: a replay needs none."""
    observations = tuple(spec for spec in robot.contract.observations if spec.peripheral is None)
    contract = attrs.evolve(robot.contract, observations=observations)
    return attrs.evolve(robot, peripherals={}, contract=contract, recording=None)


def _named(config: str, changes: tuple[str, ...], *, sim: bool) -> RobotConfig:
    """The robot of a YAML, with the mode of the replay added."""
    registry = installed_plugins()
    return _with_mode(partial(load_config, find_config(config, registry), sim=sim, registry=registry), changes)


def _recorded(summary: EpisodeSummary, changes: tuple[str, ...], *, sim: bool) -> RobotConfig:
    """The robot of a recorded episode, with the mode of the replay added."""
    text = summary.metadata.get("config")
    if text is None:
        raise RecorderError(f"{summary.path}: has no robot YAML; name one: `ibrobot replay {summary.path} CONFIG`")
    try:
        document = json.loads(text)
    except ValueError as error:
        raise RecorderError(f"{summary.path}: its robot YAML cannot be read: {error}; name one as CONFIG") from None
    return _with_mode(partial(from_document, document, source=Path("recorded config"), sim=sim), changes)


def _with_mode(load: Callable[..., RobotConfig], changes: tuple[str, ...]) -> RobotConfig:
    """Load a robot with the mode of the replay, which has only the executors of the contract's actions."""
    executors = ", ".join(dict.fromkeys(spec.executor for spec in load(overrides=changes).contract.actions))
    return load(overrides=(*changes, f"control_modes.{_MODE}={{executors: [{executors}]}}"), mode=_MODE)


def _check(contract: Contract, summary: EpisodeSummary, name: str, *, force: bool) -> None:
    """Check that the episode was recorded with this contract; an episode without its own uses that of CONFIG."""
    try:
        recorded = recorded_contract(summary.metadata)
    except ContractError as error:
        raise ContractError(f"{summary.path}: {error}") from None
    if recorded is None or recorded.fingerprint() == contract.fingerprint():
        return
    actions = [[(part.topic, part.type, part.joints) for part in each.action_parts] for each in (recorded, contract)]
    if force and actions[0] == actions[1]:
        return
    remark = (
        "its actions differ, which --force-contract does not change"
        if force
        else ("CONFIG must be of the same robot; --force-contract replays where only observations differ")
    )
    raise ContractError(
        f"{summary.path}: was recorded with another contract than that of {name}; {remark}:\n"
        f"{contract.difference(recorded, names=(name, 'recorded'))}"
    )
