"""What an agent may do in a run: nothing but reading and stopping, unless a person has granted it, and no longer."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import closing, suppress
from contextvars import Context
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from ibrobot_mcp.work import WorkServices
from ibrobot_terminal.authority import AGENT_LOG, ARM, DISARM, STATUS, Agent, Grant, authority_of

from ibrobot_core.api import (
    FollowTrajectory,
    Header,
    JointState,
    JointTrajectory,
    JointTrajectoryPoint,
    MoveJoint,
    String,
    ns,
)
from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins, load_config
from ibrobot_core.contract.specs import joint_selection
from ibrobot_core.control.commands import LimitSpeed
from ibrobot_core.errors import ContractError, HardwareError, IbrobotError, NotSupported, RequestError, TransportError

CONFIG = Path(__file__).parents[2] / "configs" / "so101_blind.yaml"
GO_TO = "/planning/go_to"
AWAY, HERE = "shoulder_pan=1.2", "shoulder_pan=0"


class AgentRun:
    """A run in lockstep with an agent, whose client gives signs of life at each tick, unless it is `frozen`."""

    config, mode = CONFIG, "moveit_planning"

    def __init__(self, scene: str = "empty", *more: str, request: Mapping[str, Any] = MappingProxyType({})) -> None:
        overrides = (f"simulation.scene={{type: {scene}}}", *more)
        config = load_config(self.config, sim=True, mode=self.mode, overrides=overrides, registry=installed_plugins())
        self.runtime = Runtime(Session(config, installed_plugins(), LaunchRequest(lockstep=True, **request)))
        self.session = self.runtime.session
        self.authority = authority_of(self.session)
        self.commands: list[np.ndarray] = []
        self.session.on_state.append(lambda state: self.commands.append(state.command.copy()))
        self.log = self.session.bus.subscribe(AGENT_LOG, 1000)
        self.frozen = False
        self.runtime.start()
        self.authority.open()
        self.agent = self.authority.join("claude")
        self.ticks(5)

    def ticks(self, count: int) -> None:
        for _ in range(count):
            if not self.frozen:
                self.authority.renew(self.agent)
            self.authority.check()
            self.runtime.step()

    def grant(self, seconds: float = 60.0, services: tuple[str, ...] = (GO_TO,), **more: Any) -> str:
        answer: str = self.session.bus.call(ARM, Grant(seconds, services, **more))
        return answer

    def go(self, goal: str = AWAY, agent: Agent | None = None) -> Any:
        return self.authority.call(agent or self.agent, GO_TO, goal)

    def moved(self, count: int) -> float:
        """How far the commands move in a number of ticks, of the joint that moves most [rad]."""
        begun = len(self.commands)
        self.ticks(count)
        return float(np.ptp(self.commands[begun - 1 :], axis=0).max())

    def events(self) -> list[dict[str, Any]]:
        return [
            json.loads(each.message.data)  # type: ignore[attr-defined]
            for each in self.log.drain()
        ]

    def close(self) -> None:
        self.authority.close()
        self.runtime.stop()


@pytest.fixture
def run() -> Iterator[AgentRun]:
    made = AgentRun()
    yield made
    made.close()


def test_recorded_episode_has_who_granted_what_before_it_began(tmp_path: Path) -> None:
    """`/agent/log` of a bag begins with the grant, or with how the last one ended."""
    run = AgentRun("empty", f"recording={{type: mcap, root: {tmp_path}, dataset: seen}}", request={"by_operator": True})
    bus = run.session.bus
    run.grant(by="a person")
    run.go("shoulder_pan=0.1")
    run.ticks(5)
    bus.call("/record_episode/start", "pan")
    run.ticks(5)
    run.go("shoulder_pan=0.2")
    run.ticks(30)
    bus.call("/record_episode/stop", "success")
    run.ticks(5)
    bus.call(DISARM)
    bus.call("/record_episode/start", "rest")
    run.ticks(10)
    bus.call("/record_episode/stop", "success")
    run.close()
    recorded = []
    for number in (1, 2):
        path = tmp_path / f"seen/episodes/episode_{number:06}"
        with closing(installed_plugins().open_episode(path)) as episode:
            messages = [each.message for each in episode.messages([AGENT_LOG])]
        entries = [json.loads(each.data) for each in messages if isinstance(each, String)]
        recorded.append([(each["event"], each.get("grant", {}).get("by", "")) for each in entries])
    assert recorded == [[("armed", "a person"), ("called", "")], [("ended", "")]]


def test_recording_that_an_agent_has_begun_ends_with_its_authority_and_is_kept(tmp_path: Path) -> None:
    run = AgentRun("empty", f"recording={{type: mcap, root: {tmp_path}, dataset: seen}}", request={"by_operator": True})
    run.grant(seconds=1.0, services=("/record_episode/start",))
    run.authority.call(run.agent, "/record_episode/start", "pan")
    run.ticks(50)
    assert run.session.episodes.running
    run.ticks(60)
    assert not run.session.episodes.running
    run.close()
    with closing(installed_plugins().open_episode(tmp_path / "seen/episodes/episode_000001")) as episode:
        assert 0.9 < (episode.summary().end_ns - episode.summary().start_ns) / 1e9 < 1.1


def test_recording_that_a_person_begins_does_not_end_with_the_grant(tmp_path: Path) -> None:
    """Only what the agent began ends, though the agent has recorded before, in the same grant."""
    run = AgentRun("empty", f"recording={{type: mcap, root: {tmp_path}, dataset: seen}}", request={"by_operator": True})
    run.grant(seconds=1.0, services=("/record_episode/start", "/record_episode/stop", "/record_episode/cancel"))
    run.authority.call(run.agent, "/record_episode/start", "of the agent")
    run.ticks(20)
    run.authority.call(run.agent, "/record_episode/stop", "success")
    run.ticks(5)
    run.session.bus.call("/record_episode/start", "of a person")
    with pytest.raises(IbrobotError, match="a person began this episode; /record_episode/stop ends it"):
        run.authority.call(run.agent, "/record_episode/cancel")
    run.ticks(100)
    assert run.session.bus.call(STATUS).ended == "its time is over"
    assert run.session.episodes.running
    assert run.session.episodes.number == 2
    run.session.bus.call("/record_episode/cancel")
    assert not run.session.episodes.running
    run.close()


def test_reset_at_a_limit_begins_where_the_load_holds_the_joint_and_no_further_out(run: AgentRun) -> None:
    """The load of the arm holds a joint a little beyond the limit at which it is commanded to be."""
    robot, states = run.session.config.robot, list[tuple[float, float]]()

    def beyond(positions: np.ndarray) -> float:
        return float(np.maximum(robot.lower - positions, positions - robot.upper).max())

    run.session.on_state.append(lambda state: states.append((beyond(state.command), beyond(state.position))))
    for goal in ("home", f"shoulder_lift={robot.lower[1]:.5f}"):
        run.session.bus.call(GO_TO, goal)
        run.ticks(400)
    command, measured = states[-1]
    assert command <= 1e-9
    assert 1e-4 < measured < 1e-3
    for mode in ("web", "moveit_planning"):  # modes begin where the commands rest, which is within the limits
        run.session.bus.call("/set_mode", mode)
        run.ticks(20)
    assert max(command for command, _ in states) <= 1e-9

    run.session.emergency_stop()
    run.ticks(40)
    begun = len(states)
    run.runtime.reset()
    run.grant()
    for mode in ("web", "moveit_planning"):
        run.session.bus.call("/set_mode", mode)
        run.ticks(20)
    run.session.bus.call(GO_TO, f"shoulder_lift={robot.lower[1]:.5f}")
    run.ticks(20)
    run.session.bus.call(GO_TO, "shoulder_lift=-1.6")
    run.ticks(200)
    commands = np.array([command for command, _ in states[begun:]])
    assert commands[0] == pytest.approx(measured, abs=1e-6)
    assert (np.diff(commands) <= 1e-9).all(), "never further out"
    assert commands[-1] < -0.1


@pytest.mark.parametrize(
    "stated", ["cl\u200baude", "\u3164claude", "cla\u202eude", "cl\u0430ude\U000e0041", "\x1bclaude", "a" * 5000]
)
def test_names_of_agents_are_short_and_read_the_same_by_everybody(run: AgentRun, stated: str) -> None:
    name = run.authority.join(stated).name
    assert name.isascii()
    assert name.isprintable()
    assert len(name) < 50


@pytest.fixture
def task_run() -> Iterator[AgentRun]:
    made = AgentRun("empty", "tasks={}")
    yield made
    made.close()


def test_agent_reads_and_stops_without_a_grant(run: AgentRun) -> None:
    assert run.authority.call(run.agent, "/planning/plan", AWAY).trajectory is not None
    with pytest.raises(HardwareError, match=r"1:claude may not move the robot: ask a person to grant it by /agent/arm"):
        run.go()
    assert run.moved(30) == 0.0
    run.authority.call(run.agent, "/estop")
    assert run.session.stops == 1


@pytest.mark.parametrize(
    ("service", "request_"), [("/reset", None), ("/agent/arm", {"seconds": 60, "services": [GO_TO]})]
)
def test_services_for_persons_are_refused_whatever_was_granted(run: AgentRun, service: str, request_: Any) -> None:
    run.grant()
    with pytest.raises(NotSupported, match=f"{service} is for persons only: ask one"):
        run.authority.call(run.agent, service, request_)
    run.session.bus.call(DISARM)
    run.grant(services=(GO_TO, service))
    with pytest.raises(NotSupported, match=f"{service} is for persons only: ask one"):
        run.authority.call(run.agent, service, request_)


def test_granted_motion_keeps_to_the_speed(run: AgentRun) -> None:
    assert run.grant(speed=0.1) == "1:claude may move the robot for 60 s at 10% of its speed"
    run.go()
    assert run.moved(600) > 1.0
    speeds = np.abs(np.diff(run.commands, axis=0)).max(axis=0) * 100.0
    limits = run.session.config.robot.max_velocity
    assert (speeds <= 0.1 * limits * 1.002).all()
    assert speeds.max() > 0.09 * limits.max()


def test_service_that_is_not_granted_is_refused(run: AgentRun) -> None:
    run.grant(services=(GO_TO,))
    with pytest.raises(HardwareError, match="/move_action is not granted; granted: /planning/go_to"):
        run.authority.call(run.agent, "/move_action", {"goals": [{"pose": "home"}]})
    with pytest.raises(HardwareError, match="/set_mode is not granted"):
        run.authority.call(run.agent, "/set_mode", "model_inference")


def end_of_time(run: AgentRun) -> None:
    run.ticks(60)


def silence(run: AgentRun) -> None:
    run.frozen = True
    run.ticks(101)


def departure(run: AgentRun) -> None:
    run.authority.leave(run.agent)


def disarming(run: AgentRun) -> None:
    run.session.bus.call(DISARM)


@pytest.mark.parametrize(
    ("ends", "why"),
    [(end_of_time, "its time is over"), (silence, "silent for"), (departure, "is gone"), (disarming, "disarmed")],
)
def test_arm_holds_when_the_authority_ends_in_motion(run: AgentRun, ends: Any, why: str) -> None:
    run.grant(seconds=0.7 if ends is end_of_time else 60.0, lease=1.0, speed=0.1)
    run.go()
    assert run.moved(20) > 0.0
    ends(run)
    run.ticks(10)  # it brakes
    assert run.moved(200) == 0.0
    assert run.commands[-1][0] < 1.1, "it has not gone on to its goal"
    assert run.session.held
    assert why in run.session.bus.call(STATUS).ended
    assert [each["event"] for each in run.events()][-2:] in (["called", "ended"], ["left", "ended"])
    with pytest.raises(HardwareError, match="may not move the robot"):
        run.go()


def test_goal_that_was_planned_when_the_authority_ended_does_not_run(run: AgentRun) -> None:
    run.grant()
    run.go()
    run.authority.end("disarmed")
    assert run.moved(100) == 0.0


def test_no_goal_passes_before_the_joints_have_braked(run: AgentRun, monkeypatch: pytest.MonkeyPatch) -> None:
    run.grant()
    monkeypatch.setattr(run.session, "hold", lambda: None)  # it waits, e.g. for a mode that is entered
    run.authority.end("disarmed")
    run.session.bus.call(GO_TO, AWAY)
    assert run.moved(100) == 0.0


def test_person_goes_on_by_entering_the_mode_and_is_not_limited(run: AgentRun) -> None:
    run.grant(speed=0.1)
    run.go()
    run.ticks(20)
    run.session.bus.call(DISARM)
    run.ticks(20)
    with pytest.raises(IbrobotError, match="holding"):
        run.session.send_goal("arm_trajectory", "x", None)  # type: ignore[arg-type]
    run.session.bus.call("/set_mode", "moveit_planning")
    run.session.bus.call(GO_TO, AWAY)
    assert run.moved(200) > 0.9
    speeds = np.abs(np.diff(run.commands[-200:], axis=0)).max() * 100.0
    assert speeds > 1.0


def test_grant_lets_a_robot_that_holds_go_on(run: AgentRun) -> None:
    run.grant(seconds=0.3)
    run.ticks(50)
    assert run.session.held
    run.grant()
    run.go()
    assert run.moved(400) > 1.0


def test_arm_does_not_sink_by_grants_and_their_ends(run: AgentRun) -> None:
    before = run.commands[-1]
    for _ in range(3):
        run.grant()
        run.ticks(5)
        run.session.bus.call(DISARM)
        run.ticks(20)
    np.testing.assert_allclose(run.commands[-1], before, atol=1e-9)


def test_stop_ends_the_authority_and_a_reset_does_not_give_it_back(run: AgentRun) -> None:
    run.grant()
    run.go()
    run.ticks(20)
    run.session.emergency_stop()
    run.ticks(40)
    with pytest.raises(HardwareError, match="refused before a reset"):
        run.grant()
    run.runtime.reset()
    assert run.moved(100) < 1e-3
    with pytest.raises(HardwareError, match="may not move the robot"):
        run.go()


def test_mode_that_a_person_enters_ends_the_authority(run: AgentRun) -> None:
    run.grant()
    run.go()
    run.ticks(20)
    run.session.bus.call("/set_mode", "web")
    assert run.session.bus.call(STATUS).armed == ""
    assert not run.session.held
    run.ticks(10)
    assert run.moved(100) == 0.0


def test_person_who_enters_the_present_mode_stops_what_the_agent_has_begun(run: AgentRun) -> None:
    run.grant(speed=0.1)
    run.go("shoulder_pan=1.2,gripper=1.7")
    run.ticks(20)
    run.session.bus.call("/set_mode", "moveit_planning")
    run.ticks(10)
    assert run.moved(200) == 0.0
    assert not run.session.held


@pytest.mark.parametrize("service", [GO_TO, "/move_action", "/execute_trajectory"])
def test_call_that_was_under_way_when_a_person_took_over_moves_nothing(run: AgentRun, service: str) -> None:
    bus = run.session.bus
    declared = bus.services()[service]
    handler = bus._servers[service].handler

    def slow(request: Any) -> Any:
        Context().run(bus.call, "/set_mode", "moveit_planning")
        return handler(request)

    bus.unserve(service)
    bus.serve(declared, slow)
    run.grant(services=(service,))
    joints = run.session.config.executors["arm_trajectory"].joints
    there = run.commands[-1][run.session.config.robot.indices(joints)] + 0.3 * np.eye(len(joints))[0]
    point = {"positions": there.tolist(), "time_from_start_ns": 2_000_000_000}
    requests: dict[str, Any] = {
        GO_TO: AWAY,
        "/move_action": {"goals": [{"joints": {"shoulder_pan": 1.2}}]},
        "/execute_trajectory": {"joint_names": list(joints), "points": [point]},
    }
    refused = ""
    try:
        run.authority.call(run.agent, service, requests[service])
    except HardwareError as error:
        refused = str(error)
    assert run.moved(200) < 1e-3
    assert f"{service}: the authority ended during the call" in refused
    bus.unserve(service)
    bus.serve(declared, handler)


def test_agent_enters_modes_that_are_granted(run: AgentRun) -> None:
    run.grant(services=(GO_TO, "/set_mode"))
    run.authority.call(run.agent, "/set_mode", "web")
    run.authority.call(run.agent, "/set_mode", "moveit_planning")
    run.go()
    assert run.moved(400) > 1.0


@pytest.mark.parametrize(
    ("service", "request_"),
    [
        ("/task/step", {"run_policy": {"mode": "model_inference", "seconds": 0.5}}),
        ("/task/step", {"alternatives": [[{"run_policy": {"mode": "model_inference", "seconds": 0.5}}]]}),
        ("/task/run", {"task": "steps:\n- run_policy: {mode: model_inference, seconds: 0.5}"}),
    ],
)
def test_task_of_an_agent_starts_policies_only_if_modes_are_granted(
    task_run: AgentRun, service: str, request_: Any
) -> None:
    modes = set()
    task_run.session.on_state.append(lambda state: modes.add(task_run.session.mode))
    outcomes = []
    for granted in ((service,), (service, "/set_mode")):
        task_run.grant(services=granted)
        number = task_run.authority.call(task_run.agent, service, request_)
        task_run.ticks(100)
        result = task_run.session.bus.call("/task/result", number)
        outcomes.append((result.outcome, "model_inference" in modes))
    assert outcomes == [("FAILED", False), ("SUCCEEDED", True)]
    assert task_run.session.mode == "moveit_planning"


def test_grant_is_for_one_connection(run: AgentRun) -> None:
    second = run.authority.join("claude")
    with pytest.raises(RequestError, match="name one agent by `agent`; connected: 1:claude, 2:claude"):
        run.grant()
    run.grant(agent="1:claude")
    with pytest.raises(HardwareError, match="2:claude may not move the robot"):
        run.go(agent=second)
    run.authority.leave(run.agent)
    again = run.authority.join("claude")
    with pytest.raises(HardwareError, match="3:claude may not move the robot"):
        run.go(agent=again)


WIDE = ((-1.0, 1.0),) * 2
REGION = {"tool.position": ((0.1, 0.4), (-0.12, 0.12), (0.0, 0.4))}


def test_path_that_leaves_the_region_is_refused_though_both_ends_are_within(run: AgentRun) -> None:
    run.session.bus.call(GO_TO, "shoulder_pan=-0.8")
    run.ticks(300)
    tool = joint_selection(run.session.config.robot, ["tool.position"])
    names = run.session.config.robot.joint_names
    poses = [np.array([pan, *run.commands[-1][1:]]) for pan in (0.8, 0.0)]
    side, across = (tool(JointState(Header(0), names, each))[0] for each in poses)
    run.grant(region={"tool.position": ((-1.0, (side + across) / 2), (-1.0, 1.0), (-1.0, 1.0))})
    run.go("shoulder_pan=0.8")
    assert run.moved(300) == 0.0
    run.go("shoulder_pan=-0.9")
    assert run.moved(300) > 0.09


@pytest.mark.parametrize(("out", "within"), [(1.5, 0.4), (-0.3, -0.1)])
def test_gripper_keeps_to_the_region(run: AgentRun, out: float, within: float) -> None:
    run.grant(region={"position.gripper": ((-0.15, 0.5),)}, speed=1.0)
    run.go(f"gripper={out}")
    assert run.moved(200) == 0.0
    run.go(f"gripper={within}")
    assert run.moved(200) > 0.09


@pytest.mark.parametrize("speed", [0.02, 0.25])
@pytest.mark.parametrize(
    ("cancel", "service", "request_"),
    [
        ("/planning/cancel", GO_TO, "gripper=1.7"),
        ("/planning/cancel", GO_TO, "shoulder_pan=1.2,gripper=1.7"),
        ("/task/cancel", "/task/run", "steps:\n- gripper: {position: 1.7}"),
        ("/task/cancel", "/task/run", "steps:\n- move: {joints: {shoulder_pan: 1.2}}"),
        ("/task/cancel", "/task/step", {"gripper": {"position": 1.7}}),
    ],
)
def test_cancel_stops_a_slow_gripper_as_it_stops_the_arm(
    task_run: AgentRun, cancel: str, service: str, request_: Any, speed: float
) -> None:
    run = task_run
    run.grant(services=(service,), speed=speed)
    run.authority.call(run.agent, service, request_)
    assert run.moved(50) > 0.005
    run.authority.call(run.agent, cancel)
    run.ticks(20)
    assert run.commands[-1][5] < 0.6
    assert run.moved(200) == 0.0


def test_gripper_of_another_client_keeps_to_the_speed_that_is_granted(run: AgentRun) -> None:
    run.grant(speed=0.1)
    run.session.send_goal("gripper_action", "of another", MoveJoint(1.7))
    run.ticks(50)
    run.session.cancel_goals("gripper_action")
    run.ticks(5)
    assert run.commands[-1][5] < 0.2
    assert run.moved(200) == 0.0


def policy(run: AgentRun, speed: float = 1.0, **more: Any) -> None:
    run.grant(services=("/set_mode",), speed=speed, **more)
    run.authority.call(run.agent, "/set_mode", "model_inference")


def test_policy_that_an_agent_begins_ends_with_the_authority() -> None:
    run = AgentRun(scene="pick_cube")
    policy(run, speed=0.2)
    assert run.moved(150) > 0.1
    speeds = np.abs(np.diff(run.commands, axis=0)).max(axis=0) * 100.0
    assert (speeds <= 0.2 * run.session.config.robot.max_velocity * 1.001).all()
    run.frozen = True
    run.ticks(1050)
    assert run.moved(200) == 0.0
    assert run.session.held
    run.close()


def test_policy_that_leaves_the_region_holds_within_it() -> None:
    run = AgentRun(scene="pick_cube")
    policy(run, region={"position.shoulder_lift": ((-1.7, -1.2),)})
    run.ticks(500)
    assert run.moved(100) == 0.0
    assert "not within the region: shoulder_lift.pos would be" in run.session.bus.call(STATUS).ended
    assert np.array(run.commands)[:, 1].max() <= -1.199
    run.close()


@pytest.mark.parametrize(
    "more",
    [
        {"region": {"tool.nothing": ((0.0, 1.0),)}},
        {"region": {"tool.position": ((0.0, 1.0),)}},
        {"region": {"tool.position": ((0.9, 1.0),) * 3}},
        {"agent": "2:nobody"},
    ],
)
def test_policy_that_holds_does_not_go_on_by_a_grant_that_is_refused(more: Any) -> None:
    run = AgentRun(scene="pick_cube")
    policy(run)
    run.ticks(100)
    run.session.bus.call(DISARM)
    run.ticks(100)
    with pytest.raises(IbrobotError):
        run.grant(**more)
    assert run.moved(150) == 0.0
    assert run.session.held
    run.close()


def test_policy_goes_on_when_its_speed_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    run = AgentRun(scene="pick_cube")
    policy(run)
    run.ticks(100)
    run.session.bus.call(DISARM)
    run.ticks(100)
    limited: list[bool] = []
    call = run.session.control.call

    def note(command: Any, *more: Any) -> Any:
        if isinstance(command, LimitSpeed):
            limited.append(run.session.held)
        return call(command, *more)

    monkeypatch.setattr(run.session.control, "call", note)
    run.grant(speed=0.1)
    assert limited == [True]
    assert run.moved(150) > 0.05
    run.close()


def test_mode_that_does_not_go_on_leaves_no_speed_limit(run: AgentRun, monkeypatch: pytest.MonkeyPatch) -> None:
    run.grant(seconds=0.3)
    run.ticks(50)
    with monkeypatch.context() as patch:
        patch.setattr(run.runtime, "_go_on", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            run.grant(speed=0.1)
    assert run.session.bus.call(STATUS).armed == ""
    run.session.bus.call("/set_mode", "moveit_planning")
    run.session.bus.call(GO_TO, AWAY)
    begun = len(run.commands)
    run.ticks(200)
    speeds = np.abs(np.diff(run.commands[begun:], axis=0)).max(axis=0) * 100.0
    assert (speeds / run.session.config.robot.max_velocity).max() > 0.5


def test_goal_out_of_the_region_moves_nothing(run: AgentRun) -> None:
    run.grant(region=REGION)
    run.go()
    assert run.moved(200) == 0.0
    run.go("shoulder_pan=0.2")
    assert run.moved(300) > 0.1


@pytest.mark.parametrize(
    ("region", "error", "match"),
    [
        ({"tool.nothing": ((0.0, 1.0),)}, ContractError, "the tool has no 'nothing'"),
        ({"tool.position": ((0.0, 1.0),)}, RequestError, "tool.position are 3 numbers"),
        (
            {"tool.position": ((-1.0, 1.0),) * 2, "position.shoulder_pan": ((-1.0, 1.0),) * 2},
            RequestError,
            "are 3 numbers",
        ),
        ({"tool.position": ((0.9, 1.0),) * 3}, HardwareError, "the robot is not in the region: ee.x would be"),
        ({"position.shoulder_pan": ((1.0, 1.0),)}, ValueError, r"give \[least, greatest\] for each number"),
    ],
)
def test_regions_that_make_no_sense_are_refused(run: AgentRun, region: Any, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        run.grant(region=region)
    assert run.session.bus.call(STATUS).armed == ""


def test_log_says_who_granted_and_what_was_asked_for(run: AgentRun) -> None:
    with pytest.raises(HardwareError):
        run.go()
    run.grant(by="Ada")
    run.go("shoulder_pan=0.1")
    events = run.events()
    assert [each["event"] for each in events] == ["joined", "refused", "armed", "called"]
    assert events[2]["grant"]["by"] == "Ada"
    assert (events[3]["service"], events[3]["request"]) == (GO_TO, '"shoulder_pan=0.1"')
    assert [each["agent"] for each in events] == ["1:claude"] * 4


def test_log_in_the_terminal_is_short_and_on_one_line(run: AgentRun, caplog: pytest.LogCaptureFixture) -> None:
    """A panel shows the newest message in full: a long one would hide the rest, or look like its rows."""
    caplog.set_level("INFO", run.session.log.name)
    with pytest.raises(IbrobotError):
        run.go("home" + " " * 80 + "grant     1 s" + "x" * 900)
    (shown,) = [each.getMessage() for each in caplog.records if " refused " in each.getMessage()]
    assert shown.startswith('agent 1:claude: refused service=/planning/go_to request="home grant 1 sxx')
    assert "ask a person to grant it" in shown
    assert len(shown) < 800
    assert len(run.events()[-1]["request"]) > 900


def test_unknown_services_are_named(run: AgentRun) -> None:
    with pytest.raises(TransportError, match="nobody serves /nothing"):
        run.authority.call(run.agent, "/nothing")


@pytest.mark.parametrize("flood", ["refused", "stops", "other services", "malformed", "connections"])
def test_log_is_bounded_in_a_flood_and_says_what_it_leaves_out(run: AgentRun, flood: str) -> None:
    granted = flood in ("other services", "malformed")
    if granted:
        run.grant()
    for _ in range(500):
        if flood == "connections":
            run.authority.leave(run.authority.join("another"))
            continue
        call = {"stops": "/planning/cancel", "other services": "/move_action"}.get(flood, GO_TO)
        with suppress(IbrobotError):
            run.authority.call(run.agent, call, {"goal": 3.0} if flood == "malformed" else AWAY * 200)
    before = run.events()
    assert 50 <= len(before) <= 55
    assert sum(len(json.dumps(each)) for each in before) < 250_000
    if granted:
        run.session.bus.call(DISARM)
    else:
        run.grant()
    (entry,) = run.events()
    (left_out,) = entry["left_out"].values() if flood != "connections" else [sum(entry["left_out"].values())]
    wanted = 1000 if flood == "connections" else 500
    assert left_out + len(before) - 1 - granted == wanted
    assert entry["event"] == ("ended" if granted else "armed")


def test_log_has_all_that_moved_though_a_flood_comes_between(run: AgentRun) -> None:
    other = run.authority.join("other")
    run.grant(agent="1:claude")
    for number in range(300):
        run.go(f"shoulder_pan=0.{number:03}")
        with suppress(IbrobotError):
            run.authority.call(other, GO_TO, AWAY)
    called = [each["request"] for each in run.events() if each["event"] == "called"]
    assert called == [f'"shoulder_pan=0.{number:03}"' for number in range(300)]


def test_flood_of_one_agent_hides_no_request_of_another(run: AgentRun) -> None:
    for number in range(100):
        with pytest.raises(HardwareError, match="ask a person"):
            run.go(f"shoulder_pan=0.{number:03}")
    other = run.authority.join("other")
    with pytest.raises(HardwareError, match="ask a person"):
        run.go("shoulder_pan=0.5", other)
    assert [each["agent"] for each in run.events()][-2:] == ["2:other", "2:other"]


def test_log_has_long_requests_that_moved_whole_and_says_what_others_lack(task_run: AgentRun) -> None:
    task = "# " + "x" * 9_000 + "\nsteps:\n- move: {pose: rest}\n"
    with pytest.raises(HardwareError):
        task_run.authority.call(task_run.agent, "/task/run", {"task": task})
    task_run.grant(services=("/task/run",))
    task_run.authority.call(task_run.agent, "/task/run", {"task": task})
    refused, called = (each for each in task_run.events() if each["event"] in ("refused", "called"))
    assert json.loads(called["request"]) == {"task": task}
    assert re.search(r"x… and 7\d\d\d characters more$", refused["request"])


def test_what_is_left_out_last_is_said_at_the_end(run: AgentRun) -> None:
    for _ in range(100):
        run.authority.call(run.agent, "/planning/cancel")
    told: list[Any] = []
    run.authority.told.append(told.append)
    run.authority.close()
    assert [(each["event"], each["left_out"]) for each in told] == [("closed", {"called": 51})]
    run.authority.open()


@pytest.fixture
def world_run() -> Iterator[AgentRun]:
    made = AgentRun("pick_cube", "tasks={}", "world={scene: true}")
    yield made
    made.close()


PERSONS = ("/reset", "/agent/arm", "/world/remove", "/world/move", "/world/attach", "/world/allow")
"""Services that agents cannot call, whatever was granted."""
FOR_GRANTS = ("/set_mode", "/execute_trajectory", "/world/add", "/world/detach", "/world/touch")
"""Services that agents can call only if somebody has granted them by name."""


def test_agent_gets_no_service_by_default_that_weakens_a_check(world_run: AgentRun) -> None:
    services = world_run.session.bus.services()
    assert {name for name, each in services.items() if each.persons} == set(PERSONS)
    world_run.session.bus.call(ARM, {"seconds": 60})  # as a person does who names nothing
    grant = world_run.session.bus.call(STATUS).grant
    assert grant is not None
    granted = set(grant.services)
    open_to_all = {name for name, each in services.items() if each.reads or each.urgent}
    assert not {name for name in open_to_all if name.startswith("/world/") and not services[name].reads}
    for name in services.keys() - granted - open_to_all:
        with pytest.raises(IbrobotError, match=r"is for persons only|is not granted; granted: /planning/go_to"):
            world_run.authority.call(world_run.agent, name)
    assert set(FOR_GRANTS) <= services.keys() - granted - open_to_all
    assert {name for name in granted if name.startswith(("/world/", "/set_mode"))} == set()


CUBE: dict[str, Any] = {"shape": "box", "size": [0.01, 0.01, 0.01]}
BELOW: dict[str, Any] = {"shape": "plane", "position": [0, 0, -0.5]}


@pytest.mark.parametrize(
    ("request_", "why"),
    [
        ({"name": "table", "replace": True, "object": BELOW}, "'table' is not of an agent: ask a person to replace it"),
        ({"name": "cube", "replace": True, "object": CUBE}, "'cube' is not of an agent"),
        ({"name": "floor", "object": BELOW}, "'floor' is a name for persons only: choose another one"),
        ({"name": "post", "object": CUBE | {"may_touch": ["gripper"]}}, "may_touch and movable are for persons only"),
        ({"name": "post", "object": CUBE | {"movable": True}}, "may_touch and movable are for persons only"),
    ],
)
def test_agent_that_may_add_objects_takes_no_obstacle_away(
    world_run: AgentRun, request_: Mapping[str, Any], why: str
) -> None:
    shapes = world_run.session.bus.call("/world/shapes")
    world_run.grant(services=("/world/add", *PERSONS))
    with pytest.raises(IbrobotError, match=why):
        world_run.authority.call(world_run.agent, "/world/add", request_)
    assert world_run.session.bus.call("/world/shapes") == shapes
    world_run.session.bus.call("/world/add", {"replace": True, **request_})  # a person may


def test_agent_replaces_what_agents_have_added_until_a_person_has(world_run: AgentRun) -> None:
    world_run.grant(services=("/world/add",))
    post: dict[str, Any] = {"name": "post", "object": CUBE | {"position": [0.4, 0, 0.3]}, "replace": True}
    world_run.authority.call(world_run.agent, "/world/add", post)
    world_run.authority.call(world_run.agent, "/world/add", post)
    world_run.session.bus.call("/world/attach", {"name": "post"})
    with pytest.raises(IbrobotError, match="'post' is not of an agent"):  # the hand carries it now
        world_run.authority.call(world_run.agent, "/world/add", post)
    world_run.session.bus.call("/world/add", post)
    with pytest.raises(IbrobotError, match="'post' is not of an agent"):
        world_run.authority.call(world_run.agent, "/world/add", post)


def test_agent_that_puts_down_an_object_does_not_say_what_it_may_touch(world_run: AgentRun) -> None:
    world_run.session.bus.call("/world/attach", {"name": "cube"})
    world_run.grant(services=("/world/detach",))
    with pytest.raises(IbrobotError, match="/world/detach: may_touch is for persons only: leave it out"):
        world_run.authority.call(world_run.agent, "/world/detach", {"name": "cube", "may_touch": ["gripper"]})
    world_run.authority.call(world_run.agent, "/world/detach", {"name": "cube"})
    assert not world_run.session.bus.call("/world/snapshot").objects["cube"].may_touch


def test_what_an_agent_lets_the_hand_touch_ends_with_its_grant(world_run: AgentRun) -> None:
    bus = world_run.session.bus

    def touched() -> bool:
        return "gripper" in bus.call("/world/snapshot").objects["table"].may_touch

    world_run.grant(services=("/world/touch",))
    world_run.authority.call(world_run.agent, "/world/touch", {"objects": ["table"]})
    assert touched()
    bus.call(DISARM)
    assert not touched()
    world_run.grant(services=("/world/touch",))
    assert not touched(), "the next grant does not bring it back"
    bus.call("/world/touch", {"objects": ["table"]})
    bus.call(DISARM)
    assert touched(), "what a person has said goes on"


@pytest.mark.parametrize("carried", [False, True])
def test_region_holds_for_an_arm_that_carries_an_object(world_run: AgentRun, carried: bool) -> None:
    """What a person attaches changes nothing of the region, and an agent cannot attach anything."""
    run, bus = world_run, world_run.session.bus
    bus.call(GO_TO, "home")
    run.ticks(400)
    if carried:
        bus.call("/world/add", {"name": "pen", "object": CUBE | {"position": [0.4, 0, 0.3]}})
        bus.call("/world/attach", {"name": "pen"})
    run.grant(services=(GO_TO, "/world/attach"), region={"position.shoulder_pan": ((-0.3, 0.3),)})
    with pytest.raises(NotSupported, match="/world/attach is for persons only: ask one"):
        run.authority.call(run.agent, "/world/attach", {"name": "cube"})
    run.go("shoulder_pan=0.8")
    assert run.moved(300) == 0.0
    run.go("shoulder_pan=0.25")
    assert run.moved(300) > 0.2
    assert run.session.bus.call(STATUS).armed == "1:claude"


PICK = """
steps:
- gripper: {position: 0.6}
- alternatives:
  - - move: {object: cube, xyz: [0, 0, 0.07], rpy: [3.14159, 0, 0], angle_tolerance: 0.2}
    - move: &down {line: [{object: cube, axis: down, angle_tolerance: 0.2}], touch: [cube, table], speed: 0.5}
  - - move: {object: cube, xyz: [0, 0, 0.07], rpy: [3.14159, 0, 1.5708], angle_tolerance: 0.2}
    - move: *down
  - - move: {object: cube, xyz: [0, 0, 0.07], rpy: [3.14159, 0, -1.5708], angle_tolerance: 0.2}
    - move: *down
- gripper: {position: -0.1, grasp: cube}
- move: {line: [{xyz: [0, 0, 0.05], relative: true}], touch: [TOUCHED]}
"""


@pytest.mark.parametrize(("touched", "outcome"), [("table", "FAILED"), ("table, floor", "SUCCEEDED")])
def test_agent_lifts_a_cube_off_the_floor_of_the_planner(world_run: AgentRun, touched: str, outcome: str) -> None:
    """The scene has a table, and planners of this robot have a floor at the same height."""
    world_run.grant(services=("/task/run",), speed=1.0)
    number = world_run.authority.call(world_run.agent, "/task/run", {"task": PICK.replace("TOUCHED", touched)})
    for _ in range(30):
        world_run.ticks(100)
        if (result := world_run.session.bus.call("/task/result", number)) is not None:
            break
    assert result is not None
    assert result.outcome == outcome
    assert ("cube is" in result.message and "from floor" in result.message) == (outcome == "FAILED")
    world = world_run.session.bus.call("/world/observed").world
    assert "floor" not in world.objects["cube"].may_touch, "the next step may no longer"
    world_run.session.bus.call("/world/detach", {"name": "cube"})  # from now on it is where the simulation has it
    world_run.ticks(2)
    (cube,) = (each for each in world_run.session.bus.call("/world/shapes") if each.name == "cube")
    assert (cube.pose.position.z > 0.04) == (outcome == "SUCCEEDED")


class TwoArms(AgentRun):
    """Two arms, which a policy moves, or goals of other clients: planners have no goals for two tools."""

    config, mode = CONFIG.with_name("bi_so101_handover.yaml"), "goals"

    def __init__(self) -> None:
        arms = [f"executors.{side}_trajectory={{type: trajectory, group: {side}}}" for side in ("left", "right")]
        both = "control_modes.goals={executors: [left_trajectory, right_trajectory]}"
        super().__init__("handover", *arms, both)

    def send(self, side: str, pan: float, seconds: float = 8.0) -> None:
        """Send a goal of another client, which turns one arm [rad]."""
        executor = f"{side}_trajectory"
        joints = self.session.config.executors[executor].joints
        there = self.commands[-1][self.session.config.robot.indices(joints)].copy()
        there[0] = pan
        points = (JointTrajectoryPoint(ns(seconds), there),)
        self.session.send_goal(executor, "other", FollowTrajectory(JointTrajectory(Header(), joints, points)))

    def pans(self) -> np.ndarray:
        """The commands of the pan of the left and the right arm in each tick [rad], shape (N, 2)."""
        return np.array(self.commands)[
            :, self.session.config.robot.indices(("left_shoulder_pan", "right_shoulder_pan"))
        ]


@pytest.fixture
def arms() -> Iterator[TwoArms]:
    made = TwoArms()
    yield made
    made.close()


def test_speed_that_is_granted_holds_for_both_arms(arms: TwoArms) -> None:
    arms.grant(services=("/set_mode",), speed=0.2)
    arms.authority.call(arms.agent, "/set_mode", "handover")
    arms.ticks(1000)
    fastest = np.abs(np.diff(arms.commands, axis=0)).max(axis=0) * 100.0 / arms.session.config.robot.max_velocity
    assert fastest == pytest.approx(0.2, rel=1e-2), "each joint of both arms is as fast as granted, and not faster"


@pytest.mark.parametrize("side", ["left", "right"])
def test_policy_of_two_arms_ends_when_one_leaves_the_region(arms: TwoArms, side: str) -> None:
    arms.grant(services=("/set_mode",), speed=0.5, region={f"position.{side}_shoulder_pan": ((-0.1, 0.1),)})
    arms.authority.call(arms.agent, "/set_mode", "handover")
    arms.ticks(900)
    assert f"not within the region: {side}_shoulder_pan.pos would be" in arms.session.bus.call(STATUS).ended
    assert np.abs(arms.pans()[:, int(side == "right")]).max() <= 0.101
    assert arms.moved(100) == 0.0, "both arms hold"


def test_region_of_one_arm_leaves_the_goals_of_the_other_alone(arms: TwoArms) -> None:
    arms.grant(services=("/set_mode",), speed=0.2, region={"position.left_shoulder_pan": ((-0.3, 0.3),)})
    with pytest.raises(IbrobotError, match=r"the path leaves the region that is granted: left_shoulder_pan.pos would"):
        arms.send("left", 0.8)
    with pytest.raises(IbrobotError, match=r"% of the speed, 20% is granted"):
        arms.send("right", 0.8, seconds=0.5)
    assert arms.moved(100) == 0.0
    arms.send("right", -0.8)
    arms.send("left", 0.25)
    arms.ticks(900)
    assert arms.pans()[-1] == pytest.approx([0.25, -0.8], abs=0.01)
    assert arms.session.bus.call(STATUS).armed == "1:claude"


def test_evaluation_ends_with_the_grant_and_one_of_a_person_goes_on(tmp_path: Path) -> None:
    run = AgentRun("empty", f"recording={{type: mcap, root: {tmp_path}/episodes, dataset: seen}}")
    bus = run.session.bus
    many: dict[str, Any] = {"episodes": 500, "mode": ["model_inference"]}
    with closing(WorkServices(run.session)):
        run.grant(seconds=0.5, services=("/evaluate",))
        number = run.authority.call(run.agent, "/evaluate", many)
        run.ticks(30)
        assert bus.call("/evaluate/progress").running
        run.ticks(40)
        assert bus.call(STATUS).ended == "its time is over"
        jobs_ended()
        assert bus.call("/evaluate/result", number).lines[0] == "cancelled"
        assert run.session.held
        assert run.moved(20) == 0.0

        run.grant(seconds=0.5, services=("/evaluate",))
        number = run.authority.call(run.agent, "/evaluate", many)
        run.authority.call(run.agent, "/evaluate/cancel")
        jobs_ended()
        bus.call("/evaluate", many)
        run.ticks(70)
        assert bus.call(STATUS).ended == "its time is over"
        assert bus.call("/evaluate/progress").running
        with pytest.raises(RequestError, match="/evaluate/cancel: a person began it"):
            run.authority.call(run.agent, "/evaluate/cancel")
        bus.call("/evaluate/cancel")
        jobs_ended()
    run.close()


def jobs_ended() -> None:
    for thread in [each for each in threading.enumerate() if each.name.startswith("job ")]:
        thread.join(30)
        assert not thread.is_alive()
