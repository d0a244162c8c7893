# mypy: disable-error-code="misc"
"""The table of entrances to motion in `docs/explanation/safety.md`: it lists all that there are, and each cell is true.

The page is the source: what a cell says is what its check measures. Cells that need what tests here do not have (ROS, a
browser, LeRobot) name the test that has it.
"""

from __future__ import annotations

import ast
import re
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import deadman_table
import entrances
import numpy as np
import pytest
from entrance_table import COLUMNS, read_table
from entrances import CAGE, FAR, UNGUARDED, WALL, Entrance, Operated
from ibrobot_planning.world.checked_arm import may_touch_arm
from ibrobot_planning.world.collision import Collisions
from ibrobot_planning.world.objects import observed_world
from ibrobot_testing.site import made_up_site

from ibrobot_core.control.commands import GetCounters

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
NUMBERS = (np.nan, np.inf, -np.inf, 1e308, -1e308)
_STILL_RAD = 2e-3
_MORE_S = 0.5
"""How long what rests is watched further [s]."""


TABLE = read_table()
CELLS = [(each, column, row.cells[column]) for row in TABLE for each in row.names for column in COLUMNS]
BEHIND_DEVICES = ("world", "guard", "STOP")
"""What teleoperation devices of one row share: it comes after what a device says."""


ADAPTERS: Mapping[str, Callable[[], Entrance]] = {
    "/planning/go_to": entrances.GoTo,
    "/move_action": entrances.MoveAction,
    "/moveit_gateway/move_to_pose": entrances.MoveToPose,
    "/moveit_gateway/move_to_configuration": entrances.MoveToConfiguration,
    "/execute_trajectory": entrances.Execute,
    "/cmd_pose": entrances.CmdPose,
    "/cmd_goal": entrances.CmdGoal,
    "/task/run": entrances.Task,
    "/task/step": entrances.TaskStep,
    "ibrobot mcp": entrances.Agent,
    "FollowJointTrajectory": entrances.FollowJointTrajectory,
    "GripperCommand": entrances.GripperCommand,
    "ParallelGripperCommand": entrances.ParallelGripperCommand,
    "lerobot-robot-ibrobot": entrances.Program,
    "ibrobot-gym": entrances.Gym,
    "engine monolithic": entrances.Policy,
    "ibrobot replay": entrances.Replay,
    "engine process": entrances.PolicyInProcess,
    "teleop cmd_vel": entrances.CmdVel,
    "teleop gamepad": lambda: Operated(deadman_table.Xbox()),
    "teleop imu": lambda: Operated(deadman_table.Imu()),
    "teleop keyboard": lambda: Operated(deadman_table.KittyKeyboard()),
    "teleop lerobot": lambda: entrances.LeRobotLeader(_folder()),
    "teleop so101_leader": lambda: entrances.Leader(deadman_table.LeaderHold(_folder())),
    "teleop spacemouse": lambda: Operated(deadman_table.SpaceMouse()),
    "teleop twist": entrances.Twists,
    "teleop web": entrances.OperatedPage,
    "teleop webxr": entrances.OperatedHeadset,
    "page jog": entrances.OperatedPage,
    "/web_teleop/jog": entrances.OperatedPage,
    "source planner": entrances.GoTo,
    "page goal": entrances.PageGoal,
    "page mode": entrances.PageMode,
    "/set_mode": entrances.SetMode,
    "/reset": entrances.Reset,
}
"""Entrance -> who uses it."""


_SERVICES = (
    "source planner", "/planning/go_to", "/move_action", "/moveit_gateway/move_to_pose",
    "/moveit_gateway/move_to_configuration", "/execute_trajectory", "/task/run", "/task/step", "/intervene",
)  # fmt: skip
_CORRECTIONS = "plugins/ibrobot-plugin-data/tests/test_corrections.py"
_LOST = f"{_CORRECTIONS}::test_a_lost_device_is_a_fault_and_a_reset_gives_the_policy_the_robot"
_SERVER = "plugins/ibrobot-plugin-serve/tests/test_distributed.py"
_PAGE = (
    "plugins/ibrobot-plugin-web/tests/test_commands.py::"
    "test_what_was_sent_before_a_stop_and_arrives_after_it_is_refused"
)
_LATE = (
    "plugins/ibrobot-plugin-zenoh/tests/test_arrivals.py::test_what_was_sent_before_a_stop_or_its_reset_moves_nothing"
)
_ALIKE = f"{_SERVER}::test_every_execution_mode_moves_alike"
_GONE = f"{_SERVER}::test_the_arm_holds_while_the_server_is_gone_and_goes_on_when_it_is_back"
_POSES = "tests/control/test_guard.py::test_motions_to_poses_of_the_robot_yaml_are_guarded"
ELSEWHERE: Mapping[tuple[str, str], str] = {
    ("page reset", "older"): _PAGE,
    ("page intervene", "older"): _PAGE,
    **{(name, "older"): _LATE for name in _SERVICES},
    **{(name, "STOP"): _LOST for name in ("source intervene", "page intervene", "/intervene")},
    **{
        (f"engine {where}", column): _ALIKE
        for where in ("process", "distributed")
        for column in ("world", "guard", "numbers", "STOP")
    },
    ("engine distributed", "silence"): _GONE,
    ("engine distributed", "caller dies"): _GONE,
    ("ibrobot replay", "numbers"): (
        "plugins/ibrobot-plugin-data/tests/test_playback.py::test_a_command_that_is_not_finite_is_refused"
    ),
    ("teleop cmd_vel", "guard"): "tests/integration/test_guarded_base.py::test_no_twist_leads_into_anything",
    **{(f"control.{key}", "guard"): _POSES for key in ("startup", "stop", "load_shedding")},
    ("control.startup", "STOP"): "tests/control/test_core_startup.py::test_a_stop_on_the_way_ends_it",
    ("control.stop", "STOP"): "tests/control/test_core_stops.py::test_nothing_moves_the_robot_any_more",
    ("control.load_shedding", "STOP"): (
        "tests/control/test_health.py::"
        "test_on_the_way_an_emergency_stop_brakes_and_holds_until_the_load_has_had_its_time_again"
    ),
}
"""Cells whose entrance cannot be here -> the test that has it, which needs a server, a page, or more of control."""
TOOLS: Mapping[str, Callable[[], Entrance]] = {
    "teleop gamepad": lambda: Operated(entrances.ToolPad()),
    "teleop keyboard": lambda: Operated(entrances.ToolKeys()),
    "teleop spacemouse": lambda: Operated(entrances.ToolMouse()),
}
"""Entrance that moves joints or the tool -> one that moves the tool."""


def _folder() -> Path:
    """A new folder, for the files of a device."""
    return Path(tempfile.mkdtemp())


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The made-up policy is installed."""
    folder = tmp_path_factory.mktemp("entrances") / "site"
    with pytest.MonkeyPatch.context() as patch, made_up_site(folder, entrances.PLUGINS, patch) as site:
        site.add("far-policy", "far_policy.py")
        yield


def ask_once(entrance: Entrance, ticks: int) -> None:
    """Ask for the far place, and let time pass."""
    if entrance.streams:
        entrance.run.ticks(ticks, entrance.ask)
    else:
        entrance.run.ticks(1, entrance.ask)
        entrance.run.ticks(ticks - 1)


def gets_going(entrance: Entrance, most: int = 100) -> None:
    """Ask, until the robot moves fast."""
    run = entrance.run
    entrance.prepare()
    for i in range(most):
        run.ticks(1, entrance.ask if entrance.streams or not i else lambda: None)
        if run.moved(len(run.commands) - 1) > 0.005:
            return
    pytest.fail("the entrance does not move the robot")


def seconds(cell: str) -> float:
    """The time in a cell [s]."""
    found = re.fullmatch(r"([\d.]+) s", cell)
    assert found, f"{cell!r} is no time in seconds"
    return float(found[1])


def ways(make: Callable[[], Entrance], ask: Callable[[Entrance], Callable[[], object]]) -> list[float]:
    """How far the robot is moved without and with walls around the tool [rad]."""
    found = []
    for walls in ((), (CAGE,)):
        entrance = make()
        try:
            run = entrance.launch(UNGUARDED, *walls)
            entrance.prepare()
            begun = len(run.commands)
            run.ticks(1, ask(entrance))
            run.ticks(150, ask(entrance) if entrance.streams else lambda: None)
            found.append(run.moved(begun))
        finally:
            entrance.close()
    return found


def check_unchecked(make: Callable[[], Entrance]) -> None:
    """Walls make no difference."""
    free, caged = ways(make, lambda entrance: entrance.ask)
    assert caged == pytest.approx(free)
    assert free > 0.1


def check_tool(name: str) -> None:
    """Walls slow the tool down."""
    free, caged = ways(TOOLS.get(name, ADAPTERS[name]), lambda entrance: entrance.ask_tool)
    assert caged < 0.8 * free, "walls make no difference"


def check_world(entrance: Entrance, cell: str) -> None:
    assert cell == "checked"
    run = entrance.launch(UNGUARDED, WALL)
    ask_once(entrance, 200)
    farthest = max(command[entrance.column] for command in run.commands)
    assert farthest < FAR - 0.01, f"went to {farthest:.2f} rad, behind the wall from {FAR} rad on"


def check_guard(entrance: Entrance, cell: str) -> None:
    """No command comes a millimetre nearer to a wall around the tool than the margin."""
    assert cell == "stops"
    run = entrance.launch(CAGE)
    entrance.prepare()
    run.ticks(1, entrance.ask)
    run.ticks(150, entrance.ask if entrance.streams else lambda: None)
    session = run.session
    guard = session.config.control.guard
    assert guard is not None
    arm = may_touch_arm(session.config.robot, session.log)
    checks = Collisions(arm, observed_world(session.bus).world, arm.joint_names, padding=guard.options.margin - 0.001)
    commands = np.array(run.commands)
    hit = checks.first_hit(commands)
    assert hit == len(commands), [str(each) for each in checks.contacts(commands[hit])]


def check_silence(entrance: Entrance, cell: str) -> None:
    run = entrance.launch()
    gets_going(entrance)
    begun = len(run.commands)
    entrance.silence()
    rest_s = seconds(cell) + entrance.ahead_s
    run.ticks(round((rest_s + _MORE_S) / run.period_s))
    assert run.rest_s(begun) <= rest_s + 1e-9
    run.check_limits()


def check_time(entrance: Entrance, cell: str) -> None:
    assert cell == "refused"
    run = entrance.launch()
    run.ticks(100)
    for off_s in (-3600.0, 3600.0, -31e6, 31e6):
        entrance.prepare()
        begun = len(run.commands)
        run.ticks(40, lambda off_s=off_s: entrance.with_time(off_s))
        run.ticks(40)
        assert run.moved(begun) < _STILL_RAD, f"a header {off_s} s off moves the robot"
    entrance.prepare()
    begun = len(run.commands)
    run.ticks(40, lambda: entrance.with_time(0.0))
    assert run.moved(begun) > _STILL_RAD, "right headers move nothing"


def check_numbers(entrance: Entrance, cell: str) -> None:
    run = entrance.launch()
    for value in NUMBERS:
        for i, ask in enumerate(entrance.with_number(value)):
            if run.session.faults:
                run.reset()
            entrance.prepare()
            begun = len(run.commands)
            run.ticks(15 if entrance.streams else 1, ask)
            run.ticks(20)
            run.check_limits()
            if cell == "refused" or not np.isfinite(value):
                assert run.moved(begun) < _STILL_RAD, f"{value} at place {i} moves the robot"
            assert not run.session.finished.is_set(), f"{value} at place {i} ends the run: {run.session.failure}"


def check_stop(entrance: Entrance, cell: str) -> None:
    run = entrance.launch()
    gets_going(entrance)
    if entrance.streams:
        entrance.ask()  # which waits to be carried out
    run.stop()
    begun = len(run.commands)
    run.ticks(40, entrance.ask)
    assert run.rest_s(begun) <= 0.15
    if cell == "run ends":
        assert run.session.finished.is_set()
        return
    run.reset()
    begun = len(run.commands)
    run.ticks(100, entrance.ask if cell != "emptied" else lambda: None)
    assert run.moved(begun) < _STILL_RAD, "it moves after the reset"
    entrance.again()
    gets_going(entrance)
    run.check_limits()


def check_older(entrance: Entrance, cell: str) -> None:
    assert cell == "refused"
    run = entrance.launch()
    older = entrance.keep()
    run.stop()
    run.ticks(30)
    run.reset()
    begun = len(run.commands)
    run.ticks(1, older)
    run.ticks(100)
    assert run.moved(begun) < _STILL_RAD, "a command from before the stop moves the robot"
    gets_going(entrance)


def check_death(entrance: Entrance, cell: str) -> None:
    run = entrance.launch()
    gets_going(entrance)
    begun = len(run.commands)
    entrance.die()
    rest_s = 0.0 if cell in ("run ends", "goal ends") else seconds(cell) + entrance.ahead_s
    run.ticks(300 if cell == "goal ends" else round((rest_s + _MORE_S) / run.period_s))
    if cell == "run ends":
        assert run.session.finished.is_set()
        run.runtime.stop()
        assert run.rest_s(begun) <= 0.15
        return
    if cell == "goal ends":
        assert abs(run.commands[-1][entrance.column] - entrance.far) < 0.05, "the motion is not completed"
    else:
        assert run.rest_s(begun) <= rest_s + 1e-9
    assert run.moved(len(run.commands) - 10) < _STILL_RAD


def alike() -> Iterator[Any]:
    """The cells that say something; what another cell shows already is `long`.

    That is what an entrance has by another name, too, e.g. its device's, and what devices of one row share.
    """
    measured: set[object] = set()
    first = {name: row.names[0] for row in TABLE for name in row.names if name.startswith("teleop ")}
    for name, column, cell in CELLS:
        if cell != "-":
            like = first.get(name, name) if column in BEHIND_DEVICES else name
            key = (ADAPTERS.get(like, like), TOOLS.get(like), column, cell)
            is_again = key in measured and (name, column) not in ELSEWHERE
            measured.add(key)
            marks = [pytest.mark.long] if is_again else []
            yield pytest.param(name, column, cell, id=f"{name}-{column}", marks=marks)


def check_elsewhere(test: str) -> None:
    """There is a test of this name."""
    file, _, name = test.partition("::")
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}


CHECKS: Mapping[str, Callable[[Entrance, str], None]] = dict(
    zip(
        COLUMNS,
        (check_world, check_guard, check_silence, check_time, check_numbers, check_stop, check_older, check_death),
        strict=True,
    )
)


@pytest.mark.usefixtures("parts")
@pytest.mark.parametrize(("name", "column", "cell"), [*alike()])
def test_cell(name: str, column: str, cell: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # for the files of devices
    if (elsewhere := ELSEWHERE.get((name, column))) is not None:
        check_elsewhere(elsewhere)
        return None
    assert name in ADAPTERS, f"say in ADAPTERS how `{name}` is used, e.g. as the other names of its row are"
    make = ADAPTERS[name]
    match cell:
        case "not checked":
            return check_unchecked(make)
        case "slows down":
            return check_tool(name)
        case "tool only":
            check_unchecked(make)
            return check_tool(name)
    entrance = make()
    try:
        CHECKS[column](entrance, cell)
    finally:
        entrance.close()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("make", [entrances.GripperCommand, entrances.ParallelGripperCommand])
def test_effort_that_is_not_finite_is_refused_by_name(
    make: type[entrances.GripperCommand], value: float, caplog: pytest.LogCaptureFixture
) -> None:
    """An effort of NaN would never be reached. A gripper's result has no text, so that the log has the name."""
    entrance = make()
    try:
        run = entrance.launch()
        entrance.prepare()
        assert not entrance.give(entrance.command(entrance.far, value))
        begun = len(run.commands)
        run.ticks(40)
        assert run.moved(begun) < _STILL_RAD
        assert f"INVALID_GOAL: max_effort must be a finite number, got {value!r}" in caplog.text
    finally:
        entrance.close()


@pytest.mark.usefixtures("parts")
def test_the_hand_of_another_run_on_the_same_table_is_avoided() -> None:
    """The other run sends at each tick where its hand is; two ticks later the guard knows it."""
    entrance = entrances.Policy()
    try:
        run = entrance.launch(
            "world.objects={other: {shape: box, size: [0.06, 0.06, 0.08], position: [0.1, -0.6, 0.06]}}"
        )
        entrance.prepare()
        session = run.session

        def place(y: float) -> None:
            session.bus.call("/world/move", {"name": "other", "position": [0.1, y, 0.06]})

        def known() -> int:
            return int(session.control.call(GetCounters())["guard"]["world_changes"])

        for y in np.linspace(-0.5, -0.16, 30).tolist():
            before = known()
            run.ticks(1, lambda y=y: place(y))
            run.ticks(1)
            assert known() == before + 1
        run.ticks(200, entrance.ask)
        assert max(command[entrance.column] for command in run.commands) < FAR - 0.01
        place(-0.6)
        run.ticks(150, entrance.ask)
        assert run.commands[-1][entrance.column] > FAR, "the way is free once the other hand is gone"
    finally:
        entrance.close()
