"""`ibrobot action …` beside a machine that serves as a robot does, and the parameters that it serves."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import attrs
import click
import pytest
from click.testing import CliRunner
from ibrobot_ros2.interfaces import action_type, service_type, to_cdr
from ibrobot_testing.command import command_line
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.commands import network as network_module
from ibrobot_zenoh.options import ZenohOptions
from ibrobot_zenoh.ros_goals import Status
from ibrobot_zenoh.ros_parameters import ParameterType, RosParameters, flat, from_parameter, to_parameter
from ibrobot_zenoh.transport import ZenohTransport

from ibrobot_core.api import NotSupported, RealClock, TransportError

from .pair import WAIT_S, client, free_endpoint, router

action = command_line("action")

type Ask = Callable[..., dict[str, Any]]
GRIP = action_type("control_msgs/action/GripperCommand")
NAME = "/grip/gripper_cmd"
GOAL = "{command: {position: 0.5}}"


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> tuple[ZenohTransport, str]:
    """A machine on the network, and its address."""
    from_options = network_module.options_from

    def options(*arguments: Any) -> ZenohOptions:
        return attrs.evolve(from_options(*arguments), shared_memory=False)

    monkeypatch.setattr(network_module, "options_from", options)
    monkeypatch.setattr(network_module, "_CONNECT_S", WAIT_S)
    address = free_endpoint()
    return router(address), address


def run(command: click.Command, address: str, *arguments: str) -> str:
    result = CliRunner().invoke(command, [*arguments, "--endpoint", address])
    if result.exception is not None:
        raise result.exception
    return result.output


@pytest.fixture
def gripper(machine: tuple[ZenohTransport, str]) -> str:
    """The server of an action whose goals beyond 1 fail, and those below 0 are rejected."""
    transport, address = machine
    goals: list[Any] = []

    def take(request: dict[str, Any], reply: Callable[[Any], None]) -> None:
        goals.append(request)
        reply({"accepted": request["goal"]["command"]["position"] >= 0})

    def end(request: dict[str, Any], reply: Callable[[Any], None]) -> None:
        position = goals[-1]["goal"]["command"]["position"]
        feedback = {"goal_id": request["goal_id"], "feedback": {"position": 0.25}}
        transport.publish_cdr(f"{NAME}/_action/feedback", GRIP.feedback, to_cdr(GRIP.feedback, feedback))
        status = Status.SUCCEEDED if position <= 1 else Status.ABORTED
        reply({"status": status, "result": {"position": position, "reached_goal": position <= 1}})

    transport.serve_ros(f"{NAME}/_action/send_goal", GRIP.send_goal, take)
    transport.serve_ros(f"{NAME}/_action/get_result", GRIP.get_result, end)
    return address


def test_actions_are_listed(gripper: str):
    assert run(action, gripper, "list") == f"{NAME}\n"
    assert run(action, gripper, "list", "-t") == f"{NAME} [control_msgs/action/GripperCommand]\n"


@pytest.mark.parametrize("word", ["send", "send_goal"])
def test_goal_is_sent_and_its_result_shown(gripper: str, word: str):
    shown = run(action, gripper, word, NAME, GRIP.name, GOAL, "--feedback")
    assert shown.startswith("Goal accepted\n")
    assert "Result:\nposition: 0.5\neffort: 0.0\nstalled: false\nreached_goal: true\n" in shown
    assert shown.endswith("Goal finished with status: SUCCEEDED\n")


def test_goals_that_fail_are_errors(gripper: str):
    with pytest.raises(TransportError, match=f"{NAME}: the goal ended as ABORTED"):
        run(action, gripper, "send", NAME, GRIP.name, "{command: {position: 2}}")
    with pytest.raises(TransportError, match="rejected the goal"):
        run(action, gripper, "send", NAME, GRIP.name, "{command: {position: -1}}")
    with pytest.raises(NotSupported, match=f"{NAME} is a {GRIP.name}, not a control_msgs/action/FollowJointTrajectory"):
        run(action, gripper, "send", NAME, "control_msgs/action/FollowJointTrajectory", "{}")
    with pytest.raises(NotSupported, match=f"no action /other on the network; there are {NAME}"):
        run(action, gripper, "send", "/other", GRIP.name, GOAL)


@pytest.fixture
def robot(machine: tuple[ZenohTransport, str]) -> tuple[Any, Ask]:
    """A run that shares its parameters, and a caller of their services."""
    transport, address = machine

    def call(name: str, request: Any) -> None:
        if request["mode"] != "teleop":
            raise NotSupported("no such mode")
        session.mode = request["mode"]

    document = {"control": {"rate_hz": 100.0, "stop": "hold"}, "peripherals": [{"name": "top"}], "transport": None}
    session: Any = SimpleNamespace(
        config=SimpleNamespace(document=document), mode="idle", bus=SimpleNamespace(call=call, services=dict),
        on_state=[], clock=RealClock(), stops=0, stopped_by="",
    )  # fmt: skip
    link: Any = SimpleNamespace(name="transport", transport=transport)
    parameters = RosParameters(session, link, lambda name: session.shared, Arrivals(session))
    session.shared = True
    parameters.start()
    caller = client(address)

    def ask(do: str, **request: Any) -> dict[str, Any]:
        kind = service_type(f"rcl_interfaces/srv/{do.capitalize()}Parameters")
        return caller.call_ros(f"{transport.node_name}/{do}_parameters", kind, request, WAIT_S)

    return session, ask


def test_parameters_are_listed_and_read(robot: tuple[Any, Ask]):
    _, ask = robot
    names = ["mode", "control.rate_hz", "control.stop", "peripherals.0.name", "transport"]
    assert ask("list")["result"]["names"] == names
    assert ask("list", prefixes=["control"])["result"]["names"] == names[1:3]
    rate, mode, unknown = ask("get", names=["control.rate_hz", "mode", "x"])["values"]
    assert (rate["type"], from_parameter(rate), from_parameter(mode)) == (ParameterType.DOUBLE, 100.0, "idle")
    assert from_parameter(unknown) is None


def test_only_the_mode_can_be_set(robot: tuple[Any, Ask]):
    session, ask = robot

    def set_(name: str, value: str) -> dict[str, Any]:
        (result,) = ask("set", parameters=[{"name": name, "value": to_parameter(value)}])["results"]
        return result

    assert set_("mode", "teleop")["successful"]
    assert session.mode == "teleop"
    for name, value, reason in (
        ("mode", "dance", "no such mode"),
        ("control.rate_hz", "5", "is read when a run starts: `ibrobot launch … --set control.rate_hz=…`"),
        ("x", "5", "there is no such parameter"),
    ):
        assert set_(name, value) == {"successful": False, "reason": reason}
    session.shared = False
    assert "/set_mode is not shared" in set_("mode", "idle")["reason"]


@pytest.mark.parametrize(
    ("value", "kind"),
    [
        (True, "BOOL"),
        (3, "INTEGER"),
        (0.5, "DOUBLE"),
        ("a", "STRING"),
        ([True], "BOOL_ARRAY"),
        ([1, 2], "INTEGER_ARRAY"),
        ([0.5, 1.5], "DOUBLE_ARRAY"),
        (["a"], "STRING_ARRAY"),
        (None, "NOT_SET"),
    ],
)
def test_values_keep_their_types(value: Any, kind: str):
    made = to_parameter(value)
    assert (made["type"], from_parameter(made)) == (ParameterType[kind], value)


def test_values_of_several_types_are_text():
    assert from_parameter(to_parameter([1, 0.5])) == [1.0, 0.5]
    assert from_parameter(to_parameter([1, "a"])) == "- 1\n- a"
    assert from_parameter(to_parameter([])) == "[]"
    assert dict(flat({"a": {"b": [1, 2]}, "c": [{"d": 1}], "e": {}})) == {"a.b": [1, 2], "c.0.d": 1, "e": {}}
