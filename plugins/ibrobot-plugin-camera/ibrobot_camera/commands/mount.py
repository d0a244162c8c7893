"""`ibrobot camera mount`: where a camera is mounted."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import attrs
import numpy as np
from ibrobot_kinematics.link_chain import Chain
from ibrobot_kinematics.poses import homogeneous
from ibrobot_kinematics.rotations import from_rpy, quaternion
from ibrobot_kinematics.urdf import Urdf, read_urdf
from ibrobot_provenance.files import replace_file
from ibrobot_terminal import Guide, Question

from ibrobot_camera.calibration import load_info
from ibrobot_camera.commands.calibrate import board_of, size_questions
from ibrobot_camera.intrinsics.board import Board
from ibrobot_camera.mounting.edit import with_transform
from ibrobot_camera.mounting.episode import Source
from ibrobot_camera.mounting.fit import Session
from ibrobot_camera.mounting.solve import Mounting, solve_mount
from ibrobot_camera.options import OpenCvOptions
from ibrobot_core.api import CameraInfo, Header, IbrobotError, SensorError, Vector, option
from ibrobot_core.app import RequestError, RobotConfig, echo, find_config, installed_plugins, load_config, wrong_input


@attrs.frozen(eq=False)
class CameraMount:
    """The measured mount of a camera, and the robot YAML to write it to."""

    source: Path
    camera: str
    link: str
    mounting: Mounting

    @property
    def line(self) -> str:
        """The line of the robot YAML."""
        return f"transform: {{parent: {self.link}, xyz: {list(self.mounting.xyz)}, rpy: {list(self.mounting.rpy)}}}"

    def save(self) -> None:
        """Write it to the robot YAML, and keep the rest as it is.

        Raises:
            SensorError: if that cannot be written.
        """
        values: dict[str, str | tuple[float, ...]] = {"parent": self.link, "xyz": self.mounting.xyz}
        mount = load_config(self.source).peripherals[self.camera].transform
        if mount is not None and mount.quaternion is not None:
            turn = quaternion(self.mounting.place[:3, :3])
            values["quaternion"] = tuple(round(float(each), 6) for each in turn)
        else:
            values["rpy"] = self.mounting.rpy
        try:
            text = self.source.read_bytes().decode()
            replace_file(self.source, with_transform(text, self.camera, values))
        except IbrobotError as error:
            raise SensorError(f"{self.source}: {error}") from None
        except (OSError, UnicodeDecodeError) as error:
            raise SensorError(f"{self.source}: cannot be written: {error}") from None


@attrs.frozen(kw_only=True)
class MountCamera(Board):
    """Measure where a camera is mounted, from recordings in which it looks at a board of `ibrobot camera board`.

    The camera is on the arm and the board lies on the table, or the camera is on a stand and the arm holds the board.
    Record an episode in which the arm stands still for a second in fifteen poses or more, turned to all sides, with the
    board in view; only pictures in which it stands still are used. If neither of them moves with the arm, measure where
    the board is, and give its place as --board-at.

    The result is the camera's `transform`. It is not given if the pictures cannot tell it, or contradict the readings
    of the joints; the message says why.
    """

    robot: str = option(typed="ROBOT", names="robot", help="robot YAML with the camera")
    episodes: tuple[Path, ...] = option(typed="EPISODES", names="episodes", help="recorded episodes")
    camera: str = option("", help="the camera, if the robot has several")
    on: str = option("", help="link that carries the camera; by default the parent of its transform, if it has one")
    board_on: str = option("", help="link that carries the board; by default the base")
    board_at: str = option(
        "",
        typed="--board-at X,Y,Z,ROLL,PITCH,YAW",
        help="where the board is, if it was measured [m, rad]: its lower left corner in the link that carries it, x to "
        "the right, y up, z out of the paper",
    )
    sim: bool = option(False, label=None, help="the recordings are of the simulated robot")
    write: bool = option(False, help="put the result into the robot YAML; its comments are kept")

    @wrong_input()
    def __call__(self) -> Mounting:
        mount = self.measured()
        if self.write:
            mount.save()
            echo(f"{mount.source}: the mount of {mount.camera} is written")
        else:
            echo(f"  {mount.line}")
        return mount.mounting

    def measured(self) -> CameraMount:
        """Measure the mount without writing it.

        Raises:
            IbrobotError: if the robot or an episode cannot be read, or cannot tell the mount.
        """
        source = find_config(self.robot, installed_plugins())
        config = load_config(source, sim=self.sim)
        camera = _camera(config, self.camera)
        if self.write and source.resolve() in {
            path.resolve() for path in installed_plugins().shipped_configs().values()
        }:
            raise RequestError(
                f"--write: {source} is shipped with ibrobot: `ibrobot config copy` makes a file of your own"
            )
        urdf, link, board_link = self._links(config, camera)
        chain = Chain(urdf, config.robot.joint_names, link, board_link)
        measured = self._measured()
        if measured is None and not chain.names:
            raise RequestError(
                f"no joint moves {board_link} against {link}: name the links with --on and --board-on, or measure the "
                "place of the board and give it as --board-at"
            )
        topic = config.peripherals[camera].published
        reads = Source(topic, config.robot.joint_names, chain.columns, self, _info(config, camera))
        shots, told, lens = [], [], None
        for number, episode in enumerate(self.episodes, 1):
            taken, own = reads.read(episode, f"episode {number}, " if len(self.episodes) > 1 else "")
            if lens is not None and (own.size != lens.size or not np.allclose(own.matrix, lens.matrix)):
                raise SensorError(f"{episode}: the camera has another calibration than in {self.episodes[0]}")
            lens = own
            shots += taken.shots
            told.append(taken.text())
        assert lens is not None
        return CameraMount(
            source, camera, link, solve_mount(Session(shots, chain, lens, measured), f": {'; '.join(told)}")
        )

    def show(self, result: Mounting) -> None:
        """Print the result."""
        for line in result.lines():
            echo(line)

    def _links(self, config: RobotConfig, camera: str) -> tuple[Urdf, str, str]:
        """The URDF, the link of the camera and that of the board."""
        path = config.robot.description.urdf
        if path is None:
            raise RequestError(
                f"robot {config.robot.name} has no URDF, which tells where its links are: set robot.description.urdf"
            )
        urdf = read_urdf(path)
        transform = config.peripherals[camera].transform
        link = self.on or (transform.parent if transform is not None else "")
        if not link:
            raise RequestError(f"--on: which link carries the camera {camera}? The links are: {', '.join(urdf.links)}")
        return urdf, link, self.board_on or urdf.root

    def _measured(self) -> Vector | None:
        """The board in its link, shape (4, 4), in OpenCV's frame: upper left corner, y down, z into the paper."""
        if not self.board_at:
            return None
        numbers = []
        with suppress(ValueError):
            numbers = [float(each) for each in self.board_at.split(",")]
        if len(numbers) != 6 or not np.isfinite(numbers).all():
            raise RequestError(f"--board-at {self.board_at}: must be six numbers, X,Y,Z [m] and ROLL,PITCH,YAW [rad]")
        placed = homogeneous(from_rpy(*numbers[3:]), np.array(numbers[:3]))
        return placed @ homogeneous(np.diag([1.0, -1.0, -1.0]), np.array([0.0, self.rows * self.square / 1000, 0.0]))


def _camera(config: RobotConfig, name: str) -> str:
    cameras = [each for each, peripheral in config.peripherals.items() if peripheral.kind == "camera"]
    known = ", ".join(cameras) or "none"
    if name and name not in cameras:
        raise RequestError(f"--camera: the robot has no camera {name!r}; it has: {known}")
    if not name and len(cameras) != 1:
        raise RequestError(f"name a camera with --camera; the robot has: {known}")
    return name or cameras[0]


def _info(config: RobotConfig, camera: str) -> CameraInfo | None:
    options = config.peripherals[camera].options
    path = options.info if isinstance(options, OpenCvOptions) else None
    return load_info(path)(Header()) if path is not None else None


def questions() -> tuple[Question, ...]:
    """The questions that a page asks."""
    return (
        Question("robot", "Robot YAML", "so101"),
        Question("episode", "Recorded episode in which the camera sees the board", "episodes/board:0"),
        Question("camera", "Camera", "wrist"),
        Question("on", "Link that carries the camera", "gripper_link"),
        Question("board_on", "Link that carries the board; empty for the base"),
        Question("board_at", "Where the board is, if it was measured: X,Y,Z [m], ROLL,PITCH,YAW [rad]"),
        *size_questions(),
        Question("simulated", "Use its simulation", default=False),
    )


def guided(answers: Mapping[str, str | bool], guide: Guide) -> None:
    """Measure from a page where a camera is mounted, and write it if the operator agrees.

    Raises:
        IbrobotError: if an answer makes no sense, or the episode cannot tell the mount.
    """
    given = {name: str(answer).strip() for name, answer in answers.items()}
    board = board_of(answers)
    mount = MountCamera(
        columns=board.columns, rows=board.rows, square=board.square, robot=given["robot"],
        episodes=(Path(given["episode"]).expanduser(),), camera=given["camera"], on=given["on"],
        board_on=given["board_on"], board_at=given["board_at"], sim=answers["simulated"] is True,
    ).measured()  # fmt: skip
    for line in mount.mounting.lines():
        guide.say(line)
    guide.say(mount.line)
    if mount.source.resolve() in {path.resolve() for path in installed_plugins().shipped_configs().values()}:
        guide.say("This robot is shipped with ibrobot: put the line into a robot YAML of your own.")
    elif guide.confirm(f"Write it into {mount.source}?", flag="--write"):
        mount.save()
        guide.say(f"{mount.source}: the mount of {mount.camera} is written")
