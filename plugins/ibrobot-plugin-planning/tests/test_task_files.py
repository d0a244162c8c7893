"""Task files: what is wrong is reported with file, line and key, before anything moves."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import attrs
import pytest
from ibrobot_kinematics.poses import orientation, pose_at
from ibrobot_kinematics.rotations import from_rpy
from ibrobot_planning.goals.grammar import upright
from ibrobot_planning.planner import PoseGoal, PositionGoal
from ibrobot_planning.tasks.checks import CheckedTask, Situation, check_task
from ibrobot_planning.tasks.format import MoveStep
from ibrobot_planning.tasks.reading import EXAMPLES, find_task, read_task
from ibrobot_planning.world.objects import Sphere, World, WorldObject
from ibrobot_planning.world.section import first_world, scene_objects
from ibrobot_testing.site import made_up_site

from ibrobot_core.app import ConfigError, Registry, RobotConfig, installed_plugins, load_config

from .table_arm import ARM, make_robot
from .test_tasks import task_robot

Check = Callable[..., CheckedTask]


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RobotConfig, Registry]]:
    """The robot in mode `plan`, loaded once."""
    folder = tmp_path_factory.mktemp("robot")
    path = folder / "robot.yaml"
    path.write_text(task_robot(folder, recorded=True))
    with pytest.MonkeyPatch.context() as patch, made_up_site(folder / "site", Path(__file__).parent, patch) as site:
        site.add("parts", "parts.py")
        registry = installed_plugins()
        yield load_config(path, sim=True, registry=registry), registry


@pytest.fixture
def check(loaded: tuple[RobotConfig, Registry]) -> Check:
    """Checks the text of a task for the arm, in mode `plan` unless another is given."""
    config, _ = loaded
    world = first_world(config.plugin_sections["world"].options, scene_objects(config))

    def checked(text: str, mode: str = "plan", parameters: tuple[str, ...] = (), **changes: Any) -> CheckedTask:
        given = {"world": world, "movable": ("cube", "ball"), **changes}
        robot = attrs.evolve(config, default_control_mode=mode)
        return check_task(read_task(text, "task.yaml", parameters), Situation(robot, **given))

    return checked


def move(goal: str) -> str:
    return f"steps:\n- move: {goal}"


UNREACHABLE = "steps.0.move: NO_IK_SOLUTION: tip cannot reach (2.000, 0.000, 0.100) m"
MALFORMED = {
    "no mapping": ("- wait", "task.yaml: expected a mapping, got a list"),
    "broken YAML": ("steps: [", "task.yaml:1: not valid YAML"),
    "no steps": ("name: x", "task.yaml: steps: required key is missing"),
    "empty steps": ("steps: []", "task.yaml:1: steps: a task has 1 to 200 steps, got 0"),
    "unknown key": ("step: []\nsteps: []", "task.yaml:1: step: unknown key, did you mean 'steps'?"),
    "unknown kind": ("steps:\n- jump: {}", "task.yaml:2: steps.0.jump: unknown key"),
    "step of no kind": (
        "steps:\n- name: x",
        "task.yaml:2: steps.x: a step has one of move, gripper, wait, run_policy, look, record, alternatives; there",
    ),
    "step of two kinds": (
        "steps:\n- {wait: {seconds: 1}, move: {pose: up}}",
        "task.yaml:2: steps.0: a step has one of move, gripper, wait, run_policy, look, record, alternatives; move and",
    ),
    "text for a number": (
        "steps:\n- wait: {seconds: soon}",
        "task.yaml:2: steps.0.wait.seconds: expected a number, got",
    ),
    "negative time": ("steps:\n- wait: {seconds: -1}", "task.yaml:2: steps.0.wait.seconds: -1.0 is too small"),
    "unknown parameter": (
        "parameters: {hover: 0.1}\nsteps:\n- move: {xyz: [0, 0, $hovr]}",
        "task.yaml:3: steps.0.move.xyz.2: no parameter 'hovr', did you mean 'hover'?",
    ),
    "no goal": (
        move("{speed: 0.5}"),
        "task.yaml:2: steps.0.move: a goal has one of pose, joints, xyz or object, any, line",
    ),
    "two goals": (move("{pose: up, xyz: [0, 0, 1]}"), "steps.0.move: a goal has one of"),
    "goals beside alternatives": (
        move("{any: [{pose: up}], beyond_reach: free}"),
        "steps.0.move: beyond_reach belongs to the goals in any",
    ),
    "constraints beside any": (
        move("{any: [{pose: up}], path_constraints: {upright: 0.1}}"),
        "steps.0.move: path_constraints belongs to the goals in any",
    ),
    "constraints in a line": (
        move("{line: [{xyz: [0, 0, 1], path_constraints: {upright: 0.1}}]}"),
        "steps.0.move: line.0: path_constraints hold on the whole line: give them beside line",
    ),
    "unknown constraint": (
        move("{pose: up, path_constraints: {uprigth: 0.1}}"),
        "steps.0.move.path_constraints.uprigth: unknown key, did you mean 'upright'?",
    ),
    "no constraint": (
        move("{pose: up, path_constraints: {}}"),
        "steps.0.move.path_constraints: path constraints have at least one of upright, region, view; there is none",
    ),
    "axis without position": (move("{pose: up, axis: down}"), "steps.0.move: axis needs a position: xyz or object"),
    "axis and orientation": (
        move("{xyz: [0, 0, 1], axis: up, rpy: [0, 0, 0]}"),
        "steps.0.move: axis and rpy exclude each",
    ),
    "axis of no length": (move("{xyz: [0, 0, 1], axis: [0, 0, 0]}"), "steps.0.move: axis has no length"),
    "axis in words": (
        move("{xyz: [0, 0, 1], axis: left}"),
        "steps.0.move.axis: expected a list or down or up, got 'left'",
    ),
    "quaternion of another length": (
        move("{xyz: [0, 0, 1], quaternion: [1, 1, 0, 0]}"),
        "steps.0.move: quaternion has length 1.41",
    ),
    "another name of the quaternion": (
        move("{xyz: [0, 0, 1], quat: [0, 0, 0, 1]}"),
        "steps.0.move.quat: unknown key; known keys: pose, joints, xyz, object, relative, axis, rpy, quaternion",
    ),
    "policy for no orientation": (move("{xyz: [0, 0, 1], beyond_reach: free}"), "beyond_reach needs an orientation"),
    "unknown policy": (
        move("{xyz: [0, 0, 1], beyond_reach: maybe}"),
        "'maybe' is not one of: refuse, nearest, keep_axis",
    ),
    "two coordinates": (move("{xyz: [0, 1]}"), "steps.0.move.xyz: expected a list of 3 values, got 2"),
    "line to a pose": (move("{line: [{pose: up}]}"), "line.0: a straight line goes to a position: xyz or object"),
    "relative to an object": (
        move("{object: can, xyz: [0, 0, 1], relative: true}"),
        "relative needs xyz, and no object",
    ),
    "speed above one": (move("{pose: up, speed: 2}"), "steps.0.move.speed: 2.0 is too large, must be at most 1"),
    "unknown mode": (
        "mode: plam\nsteps: [{wait: {seconds: 1}}]",
        "task.yaml:1: mode: unknown mode 'plam', did you mean 'plan'?",
    ),
    "mode without planner": (
        "mode: idle\nsteps: [{wait: {seconds: 1}}]",
        "task.yaml:1: mode: mode 'idle' has no planner",
    ),
    "unknown pose": (move("{pose: lef}"), "task.yaml:2: steps.0.move.pose: unknown pose 'lef', did you mean 'left'?"),
    "unknown joint": (move("{joints: {tilt: 1}}"), "task.yaml:2: steps.0.move.joints.tilt: unknown joint 'tilt'"),
    "joint of the gripper": (
        move("{joints: {jaw: 1}}"),
        "steps.0.move.joints.jaw: no executor of trajectories of mode 'plan' has joint 'jaw'",
    ),
    "joint outside its limits": (
        move("{joints: {pan: 3}}"),
        "steps.0.move.joints.pan: 3.0 rad is outside the limits -2.0 .. 2.0 rad",
    ),
    "out of reach": (move("{xyz: [2, 0, 0.1]}"), f"task.yaml:2: {UNREACHABLE}"),
    "line out of reach": (move("{line: [{xyz: [2, 0, 0.1]}]}"), f"task.yaml:2: {UNREACHABLE}"),
    "no alternative in reach": (move("{any: [{xyz: [2, 0, 0.1]}, {xyz: [3, 0, 0.1]}]}"), f"task.yaml:2: {UNREACHABLE}"),
    "orientation out of reach": (
        move("{xyz: [0.2, 0, 0.1], rpy: [0, 1.6, 0.5]}"),
        "NO_IK_SOLUTION: tip cannot take this orientation",
    ),
    "object out of reach": (move("{object: floor, xyz: [2, 0, 0.2]}"), f"task.yaml:2: {UNREACHABLE}"),
    "unknown object": (
        move("{object: cub}"),
        "task.yaml:2: steps.0.move.object: unknown object 'cub', did you mean 'cube'?",
    ),
    "unknown object to touch": (
        move("{pose: up, touch: [cup]}"),
        "task.yaml:2: steps.0.move.touch.0: unknown object 'cup'",
    ),
    "gripper outside its limits": (
        "steps:\n- gripper: {position: 2}",
        "task.yaml:2: steps.0.gripper.position: 2.0 rad is outside the limits -0.2 .. 1.2 rad",
    ),
    "unknown gripper": (
        "steps:\n- gripper: {position: 1, executor: hand}",
        "task.yaml:2: steps.0.gripper.executor: unknown gripper 'hand'; known: gripper",
    ),
    "release of nothing": (
        "steps:\n- gripper: {position: 1, release: cube}",
        "steps.0.gripper.release: no step before grasps 'cube'",
    ),
    "two grasps": (
        "steps:\n- gripper: {position: 0, grasp: cube}\n- gripper: {position: 0, grasp: can}",
        "task.yaml:3: steps.1.gripper.grasp: the gripper has 'cube' already",
    ),
    "goal at a grasped object": (
        "steps:\n- gripper: {position: 0, grasp: cube}\n- move: {object: cube}",
        "task.yaml:3: steps.1.move.object: 'cube' is in the gripper; goals cannot refer to it until its release",
    ),
    "unknown mode of a policy": (
        "steps:\n- run_policy: {mode: police, seconds: 1}",
        "steps.0.run_policy.mode: unknown mode 'police'",
    ),
    "mode without a policy": (
        "steps:\n- run_policy: {mode: plan, seconds: 1}",
        "task.yaml:2: steps.0.run_policy.mode: mode 'plan' runs no policy; modes that do: policy",
    ),
    "look at nothing": ("steps:\n- look: {}", "steps.0.look: a look has one of object, camera; there is none"),
    "near without within": ("steps:\n- look: {object: cube, near: can}", "steps.0.look: near and within go together"),
    "unknown camera": (
        "steps:\n- look: {camera: eyes}",
        "task.yaml:2: steps.0.look.camera: unknown camera 'eyes', did you mean 'eye'?",
    ),
    "recording of nothing": ("steps:\n- record: {}", "task.yaml:2: steps.0.record: no step after it runs a policy"),
    "recording of one policy twice": (
        "steps:\n- record: {}\n- record: {}\n- run_policy: {mode: policy, seconds: 1}",
        "task.yaml:3: steps.1.record: the step before it records the next policy already",
    ),
    "outcome of a task's recording": (
        "steps:\n- record: {of: task, outcome: success}",
        "steps.0.record: outcome belongs to the episode of a policy",
    ),
    "policy in a task that is recorded": (
        "steps:\n- record: {of: task}\n- run_policy: {mode: policy, seconds: 1}",
        "task.yaml:3: steps.1.run_policy.mode: a policy ends the episode that a step before it records of the task",
    ),
    "nothing left to record": ("steps:\n- move: {pose: up}\n- record: {of: task}", "steps.1.record: no step after it"),
    "alternatives without steps": (
        "steps:\n- alternatives: [[]]",
        "steps.0.alternatives: alternatives are lists of steps, each with at least one step",
    ),
    "alternatives in alternatives": (
        "steps:\n- alternatives: [[{alternatives: [[{move: {pose: up}}]]}]]",
        "steps.0.alternatives.0.0.alternatives: unknown key",
    ),
    "unknown pose in alternatives": (
        "steps:\n- alternatives:\n  - - move: {pose: up}\n  - - move: {pose: lef}",
        "task.yaml:4: steps.0.alternatives.1.0.move.pose: unknown pose 'lef', did you mean 'left'?",
    ),
    "no list of steps in reach": (
        "steps:\n- alternatives:\n  - - move: {xyz: [2, 0, 0.1]}\n  - - move: {pose: up}\n"
        "    - move: {xyz: [3, 0, 0.1]}",
        "task.yaml:5: steps.0.alternatives.1.1.move: NO_IK_SOLUTION: tip cannot reach (3.000, 0.000, 0.100) m",
    ),
    "alternatives with different objects in the gripper": (
        "steps:\n- alternatives: [[{gripper: {position: 0, grasp: cube}}], [{move: {pose: up}}]]",
        "steps.0.alternatives: the alternatives end with different objects in the gripper: 'cube', nothing",
    ),
    "recording of a task within alternatives": (
        "steps:\n- alternatives: [[{record: {of: task}}, {move: {pose: up}}]]",
        "steps.0.alternatives.0.0.record: a task is recorded by a step of its own, not by one of an alternative",
    ),
    "recording of nothing within alternatives": (
        "steps:\n- record: {}\n- alternatives: [[{record: {}}]]",
        "task.yaml:2: steps.0.record: the step after it must be a run_policy, or in the same list",
    ),
}


@pytest.mark.parametrize(("text", "message"), MALFORMED.values(), ids=MALFORMED)
def test_malformed_tasks_are_refused(check: Check, text: str, message: str):
    with pytest.raises(ConfigError) as failure:
        check(text)
    assert message in str(failure.value)
    assert failure.value.exit_code == 2


@pytest.mark.parametrize(
    "hostile",
    [
        "a\x1b[2J",
        "a\nkeys  Y lets it move",
        "a\u202eb",
        "cube\u200b",
        "a\u2028b",
        "\ud800",
        "n" * 101,
        " ",
        "cube\u3164",
    ],
)
@pytest.mark.parametrize(
    "text", ["name: {}\nsteps:\n- wait: {{seconds: 0}}", "steps:\n- {{name: {}, wait: {{seconds: 0}}}}"]
)
def test_names_are_one_line_that_everybody_reads_the_same(check: Check, text: str, hostile: str):
    with pytest.raises(ConfigError) as failure:
        check(text.format(json.dumps(hostile)))
    assert "name: a name is one line of 1 to 100 visible characters" in str(failure.value)


def test_other_texts_have_several_lines_but_no_control_characters():
    text = "steps:\n- record: {{prompt: {}}}"
    read_task(text.format(json.dumps("pick\n\tthe cube")), "task.yaml")
    with pytest.raises(ConfigError, match=r"steps.0.record.prompt: 'a\\x1b\[2J' has control characters"):
        read_task(text.format(json.dumps("a\x1b[2J")), "task.yaml")


def test_all_faults_are_reported_together(check: Check):
    with pytest.raises(ConfigError) as failure:
        check("steps:\n- move: {pose: lef}\n- gripper: {position: 9}\n- look: {camera: ear}")
    assert [problem.line for problem in failure.value.problems] == [2, 3, 4]


def test_one_list_of_alternatives_in_reach_is_enough(check: Check):
    assert check("steps:\n- alternatives: [[{move: {xyz: [2, 0, 0.1]}}], [{move: {pose: up}}]]")


def test_planner_of_joints_takes_no_positions(check: Check):
    assert check(move("{pose: up}"), mode="joint").mode.name == "joint"
    with pytest.raises(ConfigError, match=r"steps.0.move: planner type 'joint' takes joint positions only; types that"):
        check(move("{xyz: [0.2, 0, 0.1]}"), mode="joint")


def test_robot_without_world_or_recording(check: Check):
    with pytest.raises(ConfigError, match=r"steps.0.move.object: objects need a section `world` in the robot YAML"):
        check(move("{object: cube}"), world=None)
    with pytest.raises(ConfigError, match=r"steps.0.record: the run has none"):
        check("steps:\n- record: {}\n- run_policy: {mode: policy, seconds: 1}", no_recording="the run has none")


def test_objects_that_moved_are_checked_when_their_step_begins(check: Check):
    far = "move: {object: cube, xyz: [2, 0, 0]}"
    policy = "run_policy: {mode: policy, seconds: 1}"
    with pytest.raises(ConfigError, match="NO_IK_SOLUTION"):
        check(f"steps:\n- {far}")
    assert check(f"steps:\n- {policy}\n- {far}")
    assert check(f"steps:\n- {far}", elsewhere=("cube",))


def test_parameters_fill_in_numbers_words_and_text(check: Check):
    text = (
        "parameters: {z: 0.04, thing: cube, slow: 0.5}\n"
        "steps:\n"
        "- name: above the $thing\n"
        "  move: {object: $thing, xyz: [0, 0, $z], axis: down, speed: $slow}\n"
    )
    step = check(text, parameters=("z=0.05",)).file.task.steps[0]
    assert step.name == "above the cube"
    assert step.move == MoveStep(object="cube", xyz=(0.0, 0.0, 0.05), axis="down", speed=0.5)
    with pytest.raises(ConfigError, match="--param y=1: no parameter 'y'; known: z, thing, slow"):
        check(text, parameters=("y=1",))
    with pytest.raises(ConfigError, match="--param z: expected NAME=VALUE"):
        check(text, parameters=("z",))


def test_bundled_tasks_are_read():
    assert find_task("pick_cube") == EXAMPLES / "pick_cube.yaml"
    for path in EXAMPLES.glob("*.yaml"):
        assert read_task(path.read_text(encoding="utf-8"), path.name).task.name
    with pytest.raises(ConfigError, match="pick_cub: no such file; tasks that come with ibrobot: pick_cube"):
        find_task("pick_cub")


@pytest.mark.parametrize(
    ("rpy", "yaw"),
    [((0, 0, 0.4), 0.4), ((0.1, 0.05, 0.4), 0.4), ((0, 1.5707963, 0.4), 1.9707963), ((3.1415926, 0, 0.4), 0.4)],
    ids=["upright", "tilted", "on its side", "upside down"],
)
def test_goals_at_objects_are_in_an_upright_frame(tmp_path: Path, rpy: tuple[float, float, float], yaw: float):
    pose = pose_at((0.1, 0.2, 0.3), rpy)
    frame = upright(pose)
    assert frame[:3, 2].tolist() == [0, 0, 1]
    turned = orientation(from_rpy(0, 0, yaw))
    assert frame[0, 0] == pytest.approx(1 - 2 * turned.z**2, abs=0.02)
    world = World({"thing": WorldObject(Sphere(0.1), pose)})
    step = MoveStep(object="thing", xyz=(0.1, 0.0, 0.05), rpy=(0.0, 0.0, 0.0))
    target = step.target(make_robot(tmp_path), ARM, world).tool
    assert isinstance(target, PoseGoal)
    assert target.pose.position.z == pytest.approx(0.35)
    assert target.pose.orientation.z == pytest.approx(turned.z, abs=0.02)


def test_directions_at_objects_turn_with_them(tmp_path: Path):
    world = World({"thing": WorldObject(Sphere(0.1), pose_at((0.1, 0.2, 0.3), (0, 0, 1.5707963)))})
    target = MoveStep(object="thing", axis=(1.0, 0.0, 0.0)).target(make_robot(tmp_path), ARM, world).tool
    assert isinstance(target, PositionGoal)
    assert target.axis is not None
    assert (target.axis.x, target.axis.y) == pytest.approx((0, 1), abs=1e-6)
