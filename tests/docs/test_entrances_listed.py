"""Every entrance to motion has its row in the table of `docs/explanation/safety.md`, and every row its entrance.

Entrances are found in the source: types of plugins, services, topics that are read, what sends plans and goals to
control, commands of pages and of the command line. What moves nothing is named here, so that a person decides about a
new one.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path

from entrance_table import read_table

ROOT = Path(__file__).parents[2]
NAMED = {name for row in read_table() for name in row.names}
"""The entrances in the table."""
ROW = (
    "name what moves the robot in the table `Every entrance to motion` of docs/explanation/safety.md: in the row "
    "whose cells are true of it, or in a row of its own; tests/integration/test_entrances.py then measures the cells"
)
"""What to do about an entrance that the table does not have."""
KINDS = {"TeleopDescriptor": "teleop", "EngineDescriptor": "engine", "SourceDescriptor": "source"}
"""Kinds of plugins whose types are entrances of their own."""
STILL_SERVICES = {
    # What agents may do: they move the robot by the other entrances.
    "/agent/arm", "/agent/disarm", "/agent/status",
    # Ends motion.
    "/estop", "/estop/check", "/planning/cancel", "/task/cancel", "/web_teleop/release",
    # Episodes: the robot moves as its mode has it, recorded or not.
    "/record_episode/cancel", "/record_episode/discard", "/record_episode/get_info", "/record_episode/highlight",
    "/record_episode", "/record_episode/progress", "/record_episode/redo", "/record_episode/start",
    "/record_episode/status", "/record_episode/stop",
    # Tools of agents, which show the robot.
    "look", "state", "wait",
    # Answers with where objects are.
    "/find",
    # An operator's answer to a question of a command, from standard input.
    "answer",
    # Answers with what is planned or known.
    "/act_inference_node/DispatchInfer", "/compute_cartesian_path", "/compute_fk", "/compute_ik",
    "/get_planning_scene", "/plan_kinematic_path", "/planning/plan", "/planning/result", "/task/check", "/task/result",
    # The world, and how chunks are blended: they change motions that another entrance asks for.
    "/action_dispatcher/toggle_smoothing", "/clear_octomap", "/world/add", "/world/allow", "/world/attach",
    "/world/clearance", "/world/detach", "/world/move", "/world/observed", "/world/remove", "/world/shapes",
    "/world/snapshot", "/world/touch",
}  # fmt: skip
"""Services that move nothing."""
OTHER_SERVICES = {
    "ibrobot_mcp/tools.py: name": "/task/step",
    "ibrobot_kinematics/twist.py: topic": "teleop twist",
    "ibrobot_web/messages.py: name": "",  # commands of pages, see `page_commands`
    "ibrobot_web/ui/context.py: ''": "",  # requests of the page that starts runs
    "ibrobot_detect/options.py: type_": "",  # reads options
    # Work on recordings, and in simulation.
    "ibrobot_mcp/work.py: name": "",
    **{f"ibrobot_mcp/work.py: f'{{name}}/{part}'": "" for part in ("progress", "result", "cancel")},
}
"""Where services are declared whose names are computed -> the entrance that they are; empty: none."""
SUBSCRIBERS = {
    "ibrobot_planning/execution/source.py": "/cmd_pose",
    "ibrobot_kinematics/twist.py": "teleop twist",
    "ibrobot_lerobot_devices/cmd_vel.py": "teleop cmd_vel",
    # Observations of policies, records, pictures, and what is shown, counted or passed on.
    **dict.fromkeys(
        (
            "ibrobot_core/contract/frames.py", "ibrobot_data/recording_worker.py", "ibrobot_eval/episodes.py",
            "ibrobot_kinematics/description.py", "ibrobot_eval/cameras.py", "ibrobot_eval/film.py",
            "ibrobot_gym/environment.py", "ibrobot_mujoco/camera.py", "ibrobot_mujoco/viewer.py",
            "ibrobot_planning/tasks/performing.py", "ibrobot_ros/topics.py", "ibrobot_ros2/inference.py",
            "ibrobot_diagnose/watch.py", "ibrobot_kinematics/tool_pose.py", "ibrobot_web/objects.py",
            "ibrobot_web/viewer.py",
            "ibrobot_mcp/pictures.py", "ibrobot_ros2/run_cameras.py",
            "ibrobot_webxr/images.py", "ibrobot_webxr/server.py", "ibrobot_zenoh/shared_topics.py",
            # The world.
            "ibrobot_planning/world/clouds.py", "ibrobot_kinematics/run_frames.py",
            "ibrobot_planning/world/section.py",
        ),
        "",
    ),
}  # fmt: skip
"""Files that read topics of the bus -> the entrance that this is; empty: none."""
SENDERS = {
    "ibrobot_core/launch/sources/policy.py": "engine monolithic",
    "ibrobot_core/launch/sources/teleop.py": "teleop keyboard",
    "ibrobot_data/corrections.py": "source intervene",
    "ibrobot_data/handover.py": "source intervene",
    "ibrobot_data/replay_source.py": "ibrobot replay",
    "ibrobot_gym/environment.py": "ibrobot-gym",
    "ibrobot_lerobot_program/run.py": "lerobot-robot-ibrobot",
    "ibrobot_planning/execution/motions.py": "/planning/go_to",
    "ibrobot_planning/execution/source.py": "source planner",
    "ibrobot_ros2/goals.py": "FollowJointTrajectory",
    "ibrobot_diagnose/live.py": "",  # it sends nothing
    # The session, the door of goals, and control, through which all others go.
    "ibrobot_planning/execution/door.py": "",
    "ibrobot_core/control/host.py": "",
    "ibrobot_core/launch/session.py": "",
}
"""Files with command sources, or that send plans or goals to control -> an entrance that this is."""
PAGE_COMMANDS = {
    "jog": "page jog", "reset": "page reset", "call": "",
    "/set_mode": "page mode", "/planning/go_to": "page goal", "/intervene": "page intervene",
    **dict.fromkeys(
        (
            "/action_dispatcher/toggle_smoothing", "/agent/arm", "/agent/disarm", "/planning/cancel",
            "/record_episode/discard", "abandoned",
            "/record_episode/redo", "/record_episode/start", "/record_episode/stop", "finish", "operate", "preview",
            "release", "resign", "time",
        ),
        "",
    ),
}  # fmt: skip
"""Commands of pages, and the services that they may call -> an entrance that this is; empty: it moves nothing."""
OWN_MOTIONS = {"begin_startup": "control.startup", "begin_stop": "control.stop", "_shed": "control.load_shedding"}
"""Function of control that moves the robot to a pose -> the key of the robot YAML."""
COMMANDS = {
    "launch": "/planning/go_to",  # `--goal`; its modes have entrances of their own
    "record": "/planning/go_to",
    "eval": "engine monolithic",
    "replay": "ibrobot replay",
    "task": "/task/run",
    "identify": "/task/run",  # `--excite`
    "mcp": "ibrobot mcp",
    "action": "FollowJointTrajectory",
    "service": "/planning/go_to",
    "topic": "/cmd_pose",
    "bag": "/cmd_pose",
    "ui": "page goal",  # it launches runs, and shows their pages
    **dict.fromkeys(
        (
            "agent",
            "camera", "certs", "config", "config copy", "config import", "config new", "config schema", "contract",
            "convert", "damiao", "datasets", "datasets check", "datasets info", "description", "doctor", "episodes",
            "episodes delete", "episodes list", "episodes mark", "episodes repair", "episodes trash", "episodes trim",
            "explain", "export", "feetech", "gamepad",
            "lerobot", "netft", "plan", "plugins", "preflight", "serve", "train",
        ),
        "",
    ),
}  # fmt: skip
"""Commands of `ibrobot` -> an entrance that they use; empty: they move nothing."""
PROGRAMS = {
    "lerobot-robot-ibrobot": "lerobot-robot-ibrobot",
    "lerobot-env-ibrobot": "ibrobot-gym",
    "lerobot-teleoperator-ibrobot": "",  # commands another robot of LeRobot's
}
"""Packages that LeRobot discovers -> the entrance that they are."""


CALLED = (*KINDS, "Service", "subscribe", "send_plan", "write_plan", "send_goal", "Command")
"""What the tests below look for calls of, besides that of a goal."""
_SUSPECT = re.compile(
    rf"\b(?:{'|'.join(CALLED)})[(\[]|\b(?:call|command)\(\s*[\"']goal|SourceWorker|CommandSource|control_msgs/action/"
    r"|_move_to|_COMMANDS"
)
"""What a file has in which the tests below find something: parsing all files takes seconds."""


def sources() -> Iterator[tuple[str, ast.Module]]:
    """The files of core and of the plugins by their paths from the package on, without helpers of tests.

    Only those in which the tests below may find something.
    """
    for path in (*ROOT.glob("ibrobot_core/**/*.py"), *ROOT.glob("plugins/*/*ibrobot*/**/*.py")):
        parts = path.relative_to(ROOT).parts
        name = "/".join(parts[2:] if parts[0] == "plugins" else parts)
        if "tests" not in parts and not name.startswith("ibrobot_testing/"):
            text = path.read_text(encoding="utf-8")
            if _SUSPECT.search(text):
                yield name, ast.parse(text)


SOURCES = dict(sources())
NODES = [(file, node) for file, tree in SOURCES.items() for node in ast.walk(tree)]


def calls(*names: str) -> Iterator[tuple[str, ast.Call]]:
    """The calls of functions or methods with these names, with the files in which they are."""
    for file, node in NODES:
        match node:
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name) | ast.Subscript(value=ast.Name(id=name))):
                if name in names:
                    yield file, node


def assigned(file: str, name: str) -> ast.expr:
    """What a file assigns to a name."""
    for node in SOURCES[file].body:
        match node:
            case ast.AnnAssign(target=ast.Name(id=target), value=ast.expr() as value) if target == name:
                return value
            case ast.Assign(targets=[ast.Name(id=target)], value=value) if target == name:
                return value
    raise AssertionError(f"{file} assigns no {name}")


def first(call: ast.Call, keyword: str) -> str | None:
    """The first argument of a call, which may have a keyword; None if it is computed."""
    given = [word.value for word in call.keywords if word.arg == keyword] or call.args[:1]
    value = given[0].value if given and isinstance(given[0], ast.Constant) else None
    return value if isinstance(value, str) else None


def unknown(found: set[str], *known: set[str] | dict[str, str]) -> list[str]:
    """What nobody has decided about."""
    return sorted(found - {name for each in known for name in each})


def test_types_of_plugins_have_rows() -> None:
    found = {f"{KINDS[descriptor]} {first(call, 'type')}" for descriptor in KINDS for _, call in calls(descriptor)}
    assert unknown(found, NAMED) == [], ROW
    rows = {name for name in NAMED if name.split()[0] in KINDS.values()}
    assert unknown(rows, found) == [], "there is no such type"


def test_services_have_rows_or_move_nothing() -> None:
    found, computed = set(), set()
    for file, call in calls("Service"):
        if name := first(call, "name"):
            found.add(name)
        else:
            computed.add(f"{file}: {ast.unparse(call.args[0])}")
    assert unknown(found, NAMED, STILL_SERVICES) == [], f"{ROW}; a service that moves nothing goes into STILL_SERVICES"
    assert unknown(STILL_SERVICES, found) == [], "there is no such service"
    assert unknown(computed, OTHER_SERVICES) == [], "say in OTHER_SERVICES which names this makes"
    assert unknown({name for name in NAMED if name[0] == "/"}, found, {"/cmd_pose", "/cmd_goal"}) == [], (
        "there is no such service"
    )


def test_topics_that_are_read_have_rows_or_move_nothing() -> None:
    found = {file for file, call in calls("subscribe") if "bus" in ast.unparse(call.func)}
    assert unknown(found, SUBSCRIBERS) == [], f"{ROW}, and name it in SUBSCRIBERS; what moves nothing has '' there"
    assert unknown(set(SUBSCRIBERS), found) == [], "it reads no topic"
    assert set(filter(None, SUBSCRIBERS.values())) <= NAMED


def test_what_sends_plans_and_goals_to_control_has_a_row() -> None:
    found = {file for file, _ in calls("send_plan", "write_plan", "send_goal")}
    found |= {file for file, call in calls("call", "command") if call.args and ast.unparse(call.args[0]) == "'goal'"}
    for file, node in NODES:
        if isinstance(node, ast.ClassDef):
            bases = {base.id for base in node.bases if isinstance(base, ast.Name)}
            found |= {file} if bases & {"SourceWorker", "CommandSource"} else set()
    found.discard("ibrobot_core/component.py")  # the base class
    assert unknown(found, SENDERS) == [], f"{ROW}, and name it in SENDERS"
    assert unknown(set(SENDERS), found) == [], "it sends nothing"
    assert set(filter(None, SENDERS.values())) <= NAMED


def test_actions_of_ros_have_rows() -> None:
    texts = (node.value for _, node in NODES if isinstance(node, ast.Constant))
    prefix = "control_msgs/action/"
    found = {text.removeprefix(prefix) for text in texts if isinstance(text, str) and text.startswith(prefix)} - {""}
    assert unknown(found, NAMED) == [], ROW
    assert {"FollowJointTrajectory", "GripperCommand", "ParallelGripperCommand"} <= NAMED


def test_commands_of_pages_have_rows_or_move_nothing() -> None:
    trees = [assigned("ibrobot_web/messages.py", "_COMMANDS"), assigned("ibrobot_web/messages.py", "SERVICES")]
    nodes = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant))
    found = {node.value for node in nodes if isinstance(node.value, str)}
    assert unknown(found, PAGE_COMMANDS) == [], f"{ROW}, and name it in PAGE_COMMANDS; what moves nothing has '' there"
    assert unknown(set(PAGE_COMMANDS), found) == [], "pages have no such command"
    rows = {name for name in NAMED if name.startswith("page ")}
    assert rows == {name for name in PAGE_COMMANDS.values() if name}


def test_motions_of_controls_own_have_rows() -> None:
    found = {
        function.name
        for node in ast.walk(SOURCES["ibrobot_core/control/core.py"])
        if isinstance(node, ast.ClassDef)
        for function in node.body
        if isinstance(function, ast.FunctionDef) and "self._move_to(" in ast.unparse(function)
    }
    assert found == set(OWN_MOTIONS)
    assert set(OWN_MOTIONS.values()) <= NAMED


def test_commands_and_programs_use_rows_or_move_nothing() -> None:
    declared = [(file, first(call, "name")) for file, call in calls("Command") if ast.unparse(call.func) == "Command"]
    assert {file for file, name in declared if name is None} == set()
    # What is not listed itself stands for its group.
    names = {name if name in COMMANDS else str(name).partition(" ")[0] for _, name in declared}
    assert unknown(names, COMMANDS) == []
    folders = {path.name for path in (ROOT / "plugins").glob("lerobot-*")}
    assert unknown(folders, PROGRAMS) == []
    assert {*COMMANDS.values(), *PROGRAMS.values()} - {""} <= NAMED


def test_policies_and_executors_are_named() -> None:
    text = (ROOT / "ibrobot_core" / "official_plugins.json").read_text(encoding="utf-8")
    offers = json.loads(text).values()
    page = (ROOT / "docs" / "explanation" / "safety.md").read_text(encoding="utf-8")
    line = next(line for line in page.splitlines() if line.startswith("Policies of all types"))
    found = {type_ for each in offers for type_ in each.get("policy", ())}
    assert [type_ for type_ in sorted(found) if f"`{type_}`" not in line] == []
