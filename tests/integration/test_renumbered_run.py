"""A whole run after a reboot that renumbered both ports and all cameras: it finds them, or says which is which.

Two emulated arms behind USB adapters and three cameras with pictures of their own, whose numbers change between the
runs; by the command line, and by the guides of the page.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from pathlib import Path

import attrs
import numpy as np
import pytest
from ibrobot_calibration import Calibration, JointCalibration
from ibrobot_feetech.calibration import save_calibration
from ibrobot_feetech.emulator import Emulator
from ibrobot_testing.site import Site
from PIL import Image
from ui_server import UiServer, run_ui

from ibrobot_core.api import Image as ImageMessage
from ibrobot_core.api import JointState
from ibrobot_core.app import installed_plugins

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("prompt_threads")]

ROOT = Path(__file__).parents[2]
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
ENDS = {"wrist_roll": (0, 4095), "gripper": (1500, 2760)}
"""Joint -> the ends of its range, where it is another than that of the others [ticks]."""
ARMS = {"FOLLOWER": 2050, "LEADER": 2150}
"""Serial number of an adapter -> where all servos of its arm stand [ticks]."""
CAMERAS = {"top": "pci-0000:00:14.0-usb-0:1:1.0", "wrist": "pci-0000:00:14.0-usb-0:2:1.0", "side": "usb-HD_Cam_0042"}
"""Camera -> its name by the USB port, or by its serial number."""
BOOT: Mapping[str, str | int] = {"FOLLOWER": "ttyACM0", "LEADER": "ttyACM1", "top": 0, "wrist": 2, "side": 4}
REBOOT: Mapping[str, str | int] = {"FOLLOWER": "ttyACM2", "LEADER": "ttyACM0", "top": 4, "wrist": 0, "side": 2}
EXCHANGED: Mapping[str, str | int] = {**BOOT, "FOLLOWER": "ttyACM1", "LEADER": "ttyACM0"}
"""Device -> its number."""
PATIENCE_S = 90.0


@attrs.define
class Bench:
    """What is plugged in."""

    folder: Path
    arms: Mapping[str, Emulator]
    ibrobot: tuple[str, ...]

    def boot(self, numbers: Mapping[str, str | int]) -> None:
        """Number the devices."""
        for old in (*self.folder.glob("tty*"), *self.folder.glob("video*"), *self.folder.glob("by-*/*")):
            old.unlink()
        ports = []
        for serial, emulator in self.arms.items():
            port = self.folder / str(numbers[serial])
            port.symlink_to(emulator.port)
            ports.append([str(port), serial])
        (self.folder / "ports.json").write_text(json.dumps(ports))
        for camera, name in CAMERAS.items():
            node = self.folder / f"video{numbers[camera]}"
            node.write_text(camera)
            link = self.folder / ("by-path" if name.startswith("pci") else "by-id") / name
            link.parent.mkdir(exist_ok=True)
            link.symlink_to(node)

    def robot(self, follower: str, leader: str, cameras: Mapping[str, str | int], more: str = "") -> Path:
        """Write the robot YAML of an SO-101 with these ports and cameras."""
        text = (ROOT / "configs/so101.yaml").read_text(encoding="utf-8")
        patience = "retries: 200, lost_replies: 2000"
        for before, after in (
            ('port: "${IBROBOT_FOLLOWER_PORT:/dev/ttyACM0}", calibration: so101_follower',
             f'port: "{follower}", calibration: {self.folder}/FOLLOWER.json, {patience}'),
            ('port: "${IBROBOT_LEADER_PORT:/dev/ttyACM1}", calibration: so101_leader',
             f'port: "{leader}", calibration: {self.folder}/LEADER.json, deadman: none, {patience}'),
            ('device: "${IBROBOT_TOP_CAMERA:0}", width: 640, height: 480, fps: 30', f"device: {cameras['top']}"),
            ('device: "${IBROBOT_WRIST_CAMERA:2}", width: 640, height: 480, fps: 30', f"device: {cameras['wrist']}"),
            ("control: {rate_hz: 100, stop: hold}", "control: {rate_hz: 100, stop: hold, state_timeout: 60}"),
            ("max_duration_s: 20", "max_duration_s: 2"),
        ):  # fmt: skip
            assert before in text
            text = text.replace(before, after)
        path = self.folder / "desk.yaml"
        path.write_text(text + more, encoding="utf-8")
        return path

    def run(self, *arguments: object) -> tuple[int, str]:
        """Run `ibrobot` in the folder; its exit code, and what it printed."""
        done = subprocess.run(
            [*self.ibrobot, *map(str, arguments)], cwd=self.folder, capture_output=True, text=True,
            stdin=subprocess.DEVNULL, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        return done.returncode, done.stdout + done.stderr

    def hand(self) -> None:
        """Let a hand move the leader's pan joint to and fro, a step whenever the leader is asked something."""
        path = (ARMS["LEADER"] + round(60 * math.sin(each / 40)) for each in itertools.count())
        pan = self.arms["LEADER"].servos[1]
        self.arms["LEADER"].on_request = lambda: pan.turn(next(path))


@pytest.fixture
def bench(tmp_path: Path, ibrobot: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Both arms and the cameras, for the processes that a test starts; this process sees its own devices."""
    site = tmp_path / "site"
    site.mkdir()
    Site(site, ROOT / "tests/shared/plugins").add("renumbered", "renumbered.py")
    monkeypatch.setenv("PYTHONPATH", str(site))
    monkeypatch.setenv("RENUMBERED", str(tmp_path))
    rng = np.random.default_rng(1)
    for camera in CAMERAS:  # each sees another scene
        blocks = rng.integers(20, 235, (12, 16, 3), np.uint8)
        Image.fromarray(blocks.repeat(20, axis=0).repeat(20, axis=1)).save(tmp_path / f"{camera}.png")
    with ExitStack() as stack:
        arms = {serial: stack.enter_context(Emulator(6)) for serial in ARMS}
        for serial, emulator in arms.items():
            joints = {name: JointCalibration(i, 0, 0, *ENDS.get(name, (900, 3200))) for i, name in enumerate(JOINTS, 1)}
            save_calibration(attrs.evolve(Calibration(joints), adapter=serial), tmp_path / f"{serial}.json")
            for joint in joints.values():
                servo = emulator.servos[joint.id]
                servo.set("min_position_limit", joint.range_min)
                servo.set("max_position_limit", joint.range_max)
                servo.turn(ARMS[serial])
        yield Bench(tmp_path, arms, ibrobot)


def messages(episode: Path, topic: str) -> list[object]:
    with closing(installed_plugins().open_episode(episode)) as reader:
        return [each.message for each in reader.messages({topic})]


def test_a_run_finds_everything_by_what_stays(bench: Bench) -> None:
    bench.boot(BOOT)
    bench.robot("serial:FOLLOWER", "serial:LEADER", CAMERAS)
    bench.boot(REBOOT)  # the robot YAML stays as it is
    bench.hand()
    code, said = bench.run(
        "record", "desk.yaml", "--mode", "teleop", "--headless", "--auto", "--dataset", "pick", "--episodes", 1
    )
    assert code == 0, said
    assert "recorded   1 of 1 episode" in said
    episode = bench.folder / "episodes/pick/episodes/episode_000001"
    states = [each for each in messages(episode, "/joint_states") if isinstance(each, JointState)]
    followed = np.array([each.position for each in states])[-1] / (2 * math.pi) * 4096 + 2048
    leads = [ARMS["LEADER"]] * 5  # as its hand has moved the pan joint, and the gripper by its own range
    np.testing.assert_allclose(followed[:5], leads, atol=70)
    assert bench.arms["FOLLOWER"].servos[2].get("present_position") == pytest.approx(ARMS["LEADER"], abs=10)
    assert not any(servo.torque for servo in bench.arms["LEADER"].servos.values()), "a leader is moved by hand"
    seen = {camera: np.asarray(Image.open(bench.folder / f"{camera}.png"), float) for camera in CAMERAS}
    for camera in ("top", "wrist"):
        shown = messages(episode, f"/camera/{camera}/image_raw")[-1]
        assert isinstance(shown, ImageMessage)
        picture = shown.data.reshape(shown.height, shown.width, 3)[..., ::-1].astype(float)
        away = {name: np.abs(each - picture).mean() for name, each in seen.items()}
        assert min(away, key=lambda name: away[name]) == camera, away


def test_a_run_that_counts_ports_moves_nothing_and_says_which_is_which(bench: Bench) -> None:
    follower, leader = (str(bench.folder / name) for name in ("ttyACM0", "ttyACM1"))
    bench.robot(follower, leader, {"top": 0, "wrist": 2})
    bench.boot(EXCHANGED)
    before = goals(bench)
    code, said = bench.run("launch", "desk.yaml", "--mode", "teleop", "--headless", "--duration", 1)
    assert code == 1, said
    assert f"{follower}: this is another arm: its adapter has the USB serial number LEADER" in said
    assert "`port: serial:FOLLOWER`, which finds it wherever it is" in said
    assert goals(bench) == before


def test_the_guides_of_the_page_say_which_is_which(bench: Bench) -> None:
    bench.boot(EXCHANGED)

    async def test(server: UiServer) -> None:
        for guide, names in (("ports", tuple(ARMS)), ("cameras", tuple(CAMERAS.values()))):
            await server.post("devices/start", name=guide)
            async with asyncio.timeout(PATIENCE_S):
                while (found := await server.get("devices/state"))["state"] == "running":
                    await asyncio.sleep(0.02)
            assert found["state"] == "done", found
            assert [each for each in names if each not in json.dumps(found["items"])] == []

    run_ui([bench.folder], test)


def goals(bench: Bench) -> dict[str, list[int]]:
    """Where each servo was told to go [ticks]."""
    return {serial: [servo.get("goal_position") for servo in arm.servos.values()] for serial, arm in bench.arms.items()}


def test_pictures_tell_counted_cameras_apart(bench: Bench) -> None:
    bench.boot(BOOT)
    refuses = "\npreflight: {against: rig.json, action: refuse, seconds: 0.5}\n"
    bench.robot("serial:FOLLOWER", "serial:LEADER", {"top": 0, "wrist": 2}, refuses)
    _, said = bench.run("preflight", "desk.yaml", "--mode", "teleop", "--seconds", 0.5, "--take", "rig.json")
    assert "reference -> rig.json" in said, said  # a busy machine may slow the loop, which is a fault of the rig
    bench.boot({**BOOT, "top": 2, "wrist": 0})
    before = goals(bench)
    code, said = bench.run("launch", "desk.yaml", "--mode", "teleop", "--headless", "--duration", 1)
    assert (code, "The cameras top and wrist are exchanged" in said) == (1, True), said
    assert goals(bench) == before
