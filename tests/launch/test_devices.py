"""Several teleoperation devices in one mode: each moves its own joints, and a lost one stops all."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ibrobot_core.errors import ComponentFailed, TeleopError
from ibrobot_core.interfaces import JointReading, TeleopCommand

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.launch.runtime import Runtime

TWO = (
    "control_modes.teleop.teleop={arm: left, gripper: right}",
    "teleoperation.left={type: lever}",
    "teleoperation.right={type: lever}",
)


@pytest.fixture
def run(runs: Runs) -> Runtime:
    runtime = runs.start(*TWO, mode="teleop", by_operator=True)
    for name in ("left", "right"):
        runs.parts.MADE[name].velocity = 0.1
    return runtime


def way(run: Runtime, ticks: int = 30) -> list[bool]:
    """Which joints move in so many ticks."""
    for _ in range(15):  # a reset on the move brakes within the limits
        run.step()
    assert run.session.state is not None
    before = run.session.state.command
    for _ in range(ticks):
        run.step()
    return [bool(each) for each in np.abs(run.session.state.command - before) > 1e-6]


def unplug(device: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(measured: object) -> TeleopCommand:
        raise TeleopError("unplugged")

    monkeypatch.setattr(device, "read", gone)


def test_each_device_sees_and_moves_its_own_joints(run: Runtime, runs: Runs) -> None:
    left, right = runs.parts.MADE["left"], runs.parts.MADE["right"]
    assert way(run) == [False, False]
    left.press()
    assert way(run) == [True, False]
    right.press()
    assert way(run) == [True, True]
    left.pressed = False
    assert way(run) == [False, True]


def test_the_plan_names_each_device_with_its_joints(run: Runtime) -> None:
    (source,) = [component for component in run.plan.components if component.name == "mode:teleop"]
    assert source.summary == "teleop left (lever) moves arm, right (lever) moves gripper"


@pytest.mark.parametrize("lost", ["left", "right"])
def test_a_lost_device_stops_all_joints_until_a_reset_and_every_deadman(
    run: Runtime, runs: Runs, lost: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right = runs.parts.MADE["left"], runs.parts.MADE["right"]
    left.press()
    right.press()
    assert way(run) == [True, True]
    with monkeypatch.context() as patched:
        unplug(runs.parts.MADE[lost], patched)
        assert way(run) == [False, False]
    assert run.session.faults == ("unplugged",)

    run.reset()
    assert way(run) == [False, False], "the deadman of the other device counts as released, too"
    left.press()
    right.press()
    assert way(run) == [True, True]


def test_devices_lost_together_are_connected_again_together(
    run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        for name in ("left", "right"):
            unplug(runs.parts.MADE[name], patched)
        run.step()
        run.step()
    assert run.session.faults == ("unplugged; unplugged",)
    run.reset()
    runs.parts.MADE["right"].press()
    assert way(run) == [False, True]


def test_a_device_cannot_move_joints_of_another(run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    left = runs.parts.MADE["left"]
    left.operated = False
    monkeypatch.setattr(left, "read", lambda measured: TeleopCommand({"pan": 0.1, "grip": 0.9}))
    assert way(run) == [False, False]
    assert run.session.faults == ("left: commands joints that are not its own: grip",)


def test_a_device_that_reports_no_deadman_moves_nothing(
    run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = runs.parts.MADE["left"]
    monkeypatch.setattr(left, "read", lambda measured: TeleopCommand({"pan": 0.1}))
    assert way(run) == [False, False]
    (fault,) = run.session.faults
    assert fault.startswith("FakeTeleop commands positions without a deadman: its read must call self.deadman.report")


def test_any_device_stops_the_robot(run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    runs.parts.MADE["left"].press()
    assert way(run) == [True, False]
    with monkeypatch.context() as patched:
        patched.setattr(runs.parts.MADE["right"], "read", lambda measured: TeleopCommand(None, estop=True))
        run.step()
    assert way(run) == [False, False]
    assert "emergency stop" in run.session.faults[0]


def test_events_of_all_devices_count(run: Runtime, runs: Runs) -> None:
    runs.parts.MADE["left"].events = ("start",)
    runs.parts.MADE["right"].events = ("success", "discard")
    run.step()
    run.step()
    assert [run.session.operator_events.get_nowait() for _ in range(3)] == ["start", "success", "discard"]


def test_the_run_ends_when_every_device_has_finished(run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    done = TeleopCommand(None, finished=True)
    monkeypatch.setattr(runs.parts.MADE["left"], "read", lambda measured: done)
    assert not any(run.step() for _ in range(5))
    monkeypatch.setattr(runs.parts.MADE["right"], "read", lambda measured: done)
    assert any(run.step() for _ in range(5))


def test_a_device_that_does_not_connect_fails_the_start_and_the_other_is_released(
    runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    released: list[str] = []
    runtime = runs.make(*TWO, mode="teleop")
    kind = runs.parts.FakeTeleop
    monkeypatch.setattr(kind, "disconnect", lambda self: released.append(self.name))

    def connect(self: Any) -> None:
        self.name = next(name for name, made in runs.parts.MADE.items() if made is self)
        if self.name == "right":
            raise TeleopError("no such port")

    monkeypatch.setattr(kind, "connect", connect)
    with pytest.raises(ComponentFailed, match="mode:teleop: no such port"):
        runtime.start()
    assert sorted(released) == ["left", "right"]


def test_help_has_a_line_for_each_device(run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runs.parts.MADE["left"], "help", lambda: "hold the left lever")
    monkeypatch.setattr(runs.parts.MADE["right"], "help", lambda: "hold the right lever")
    assert run.session.command_source.help() == "hold the left lever\nhold the right lever"


def test_core_drops_positions_of_a_device_that_does_not_heed_its_own_deadman(
    run: Runtime, runs: Runs, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = runs.parts.MADE["left"]

    def read(measured: JointReading) -> TeleopCommand:
        left.deadman.report(left.pressed, measured.stamp_ns)
        return TeleopCommand({"pan": float(measured.position[0]) + 0.01})

    monkeypatch.setattr(left, "read", read)
    assert way(run) == [False, False]
    left.press()
    assert way(run) == [True, False]
    run.session.emergency_stop()
    run.step()
    run.reset()
    assert way(run) == [False, False], "it is still pressed"


def test_a_device_that_leaves_a_joint_of_an_executor_out_is_reported(
    runs: Runs, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run = runs.start(
        "robot.groups.both=[pan, grip]", "executors.both={type: position, group: both}",
        "control_modes.teleop={executors: [both], teleop: left}",
        "teleoperation.left={type: lever}", mode="teleop", by_operator=True,
    )  # fmt: skip
    left = runs.parts.MADE["left"]
    left.operated = False
    monkeypatch.setattr(left, "read", lambda measured: TeleopCommand({"pan": 0.1}))
    assert way(run) == [False, False]
    (warning,) = (record.getMessage() for record in caplog.records if "leaves" in record.getMessage())
    assert warning.startswith("left (lever) leaves grip of executor both out, so its other joints hold, too: ")
