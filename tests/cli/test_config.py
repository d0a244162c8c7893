"""`ibrobot config`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from ibrobot_core.config.yaml_nodes import parse_yaml

if TYPE_CHECKING:
    from tests.cli.conftest import Ran

Ibrobot = Callable[..., "Ran"]


def test_check_of_a_good_file(ibrobot: Ibrobot, robot: Path) -> None:
    ran = ibrobot("config", "check", "mini.yaml")

    assert (ran.code, ran.err) == (0, "")
    assert ran.out.splitlines() == [
        "mini.yaml: ok (mini, 1 joint, hardware)",
        "joints brake from full speed within 200 ms",
        "modes: idle; starts in idle",
    ]


def test_check_tells_every_fault_on_its_own_line(ibrobot: Ibrobot, robot: Path) -> None:
    robot.write_text(robot.read_text().replace("port: /dev/null", "prot: /dev/null, max_speed: 9"))

    ran = ibrobot("config", "check", "mini.yaml", "--set", "control.rate_hz=abc")

    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (
        "error: mini.yaml:6: hardware.port: required key is missing\n"
        "error: mini.yaml:6: hardware.prot: unknown key, did you mean 'port'?\n"
        "error: mini.yaml:6: hardware.max_speed: 9.0 is too large, must be at most 6.5 rad/s\n"
        "error: --set control.rate_hz=abc: control.rate_hz: expected a number, got 'abc'\n"
    )


def test_check_as_json(ibrobot: Ibrobot, robot: Path) -> None:
    assert json.loads(ibrobot("config", "check", "mini.yaml", "--json").out) == []
    robot.write_text(robot.read_text().replace("max_velocity: 2.0", "max_velocity: fast"))

    ran = ibrobot("config", "check", "mini.yaml", "--json")

    assert ran.code == 2
    assert json.loads(ran.out) == [
        {
            "file": "mini.yaml",
            "line": 4,
            "path": "robot.joints.pan.max_velocity",
            "message": "expected a number, got 'fast'",
        }
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["mini.yaml", "--sim"], "mini.yaml: --sim needs a simulation section, e.g. simulation: {type: mujoco}"),
        (
            ["mini.yaml", "--mode", "idel"],
            "--mode idel: default_control_mode: unknown control mode 'idel', did you mean 'idle'?",
        ),
        (["nowhere/x.yaml"], "nowhere/x.yaml: no such file"),
    ],
)
def test_check_of_what_cannot_be(ibrobot: Ibrobot, robot: Path, arguments: list[str], message: str) -> None:
    ran = ibrobot("config", "check", *arguments)

    assert (ran.code, ran.err) == (2, f"error: {message}\n")


def test_show_fills_in_the_defaults_and_loads_again(ibrobot: Ibrobot, robot: Path) -> None:
    shown = ibrobot("config", "show", "mini.yaml", "--set", "control.rate_hz=50")

    document = parse_yaml(shown.out, "shown").root
    assert document["hardware"]["max_speed"] == 3.0
    assert document["control"] == {
        "rate_hz": 50.0,
        "startup": "hold",
        "stop": "hold",
        "priority": 60,
        "state_timeout": 0.1,
        "peer_timeout": 0.3,
        "stop_time": 0.3,
        "following_error": {"distance": 0.25, "timeout": 2.0},
        "load_shedding": {"after": 60.0, "pose": ""},
        "guard": None,
    }
    robot.write_text(shown.out)
    assert ibrobot("config", "show", "mini.yaml").out == shown.out


@pytest.mark.parametrize("align", ["", ", align: {stamp: receive}"])
def test_a_type_without_a_header_is_said_to_go_by_receipt(ibrobot: Ibrobot, robot: Path, align: str) -> None:
    observation = "key: observation.touch, topic: /touch, type: std_msgs/msg/Float32MultiArray, select: [data.0]"
    robot.write_text(f"{robot.read_text()}\ncontract: {{observations: [{{{observation}{align}}}]}}\n")

    ran = ibrobot("config", "check", "mini.yaml")

    note = "note: observation.touch: a std_msgs/msg/Float32MultiArray has no header: /touch goes by the time of receipt"
    assert (ran.code, ran.out.splitlines()[3:]) == (0, [] if align else [note]), "who says so needs no note"
