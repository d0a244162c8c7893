"""Features of the contract: numbers of the tool's pose and their inverse, relative actions, names, and clear errors."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_calibration.joint_units import calibrated_units
from ibrobot_kinematics import Target, read_mjcf
from ibrobot_kinematics.feature_vectors import FeatureVectors
from ibrobot_kinematics.follow import follow
from ibrobot_kinematics.rotations import exp
from ibrobot_kinematics.tool_features import from_rotation_6d, rotation_6d, tool_model

from ibrobot_core.api import Contract, ContractError, Description, Joint, PolicySpec, Robot, Vector

from .arms import FIVE, SIX, bent, load, write_arm

STATE = "observation.state"
ROTATIONS = ("rotation_6d", "rotation_vector", "quaternion")
NAMES: Mapping[str, tuple[str, ...]] = {
    "position": ("ee.x", "ee.y", "ee.z"),
    "rotation_6d": ("ee.r11", "ee.r21", "ee.r31", "ee.r12", "ee.r22", "ee.r32"),
    "rotation_vector": ("ee.wx", "ee.wy", "ee.wz"),
    "quaternion": ("ee.qx", "ee.qy", "ee.qz", "ee.qw"),
    "delta_position": ("ee.delta_x", "ee.delta_y", "ee.delta_z"),
    "delta_rotation_vector": ("ee.delta_wx", "ee.delta_wy", "ee.delta_wz"),
}
FORMS = [
    *(("position", turn) for turn in ROTATIONS),
    ("position",),
    ("delta_position", "delta_rotation_vector"),
    ("delta_position",),
]
"""Parts of a pose that are an action."""


def tool(parts: tuple[str, ...]) -> list[str]:
    return [f"tool.{part}" for part in parts]


@attrs.frozen
class Arm:
    """An arm with a gripper, and the contract of its robot."""

    robot: Robot

    @property
    def joints(self) -> tuple[str, ...]:
        return self.robot.joint_names[:-1]

    @property
    def document(self) -> dict[str, Any]:
        joints = [{"name": each.name, "lower": each.lower, "upper": each.upper} for each in self.robot.joints]
        return {"robot": {"joints": joints}, "hardware": {"type": "made_up", "anchored": []}}

    def contract(self, features: list[str], state: list[str] | None = None, gripper: tuple[str, ...] = ()) -> Contract:
        """The contract with features in place of the arm's joints, as a recording has it."""
        names = {path.partition(".")[0] for path in (*features, *(state or ()), *gripper)}
        model = {
            name: self._model(name, [*features, *(state or ()), *gripper]) for name in sorted(names & {"tool", "delta"})
        }
        observed = state or [f"position.{name}" for name in self.robot.joint_names]
        align = {"strategy": "hold", "stamp": "header", "tol_ms": None}
        seen: dict[str, Any] = {
            "topic": "/joint_states",
            "type": "sensor_msgs/msg/JointState",
            "select": observed,
            "encoding": None,
        }
        seen |= {"shape": [-1], "align": align, "model": model}
        action: dict[str, Any] = {
            "topic": "/arm",
            "type": "std_msgs/msg/Float64MultiArray",
            "joints": list(self.joints),
        }
        jaw: dict[str, Any] = {**action, "topic": "/jaw", "joints": [self.robot.joint_names[-1]]}
        action |= {"features": features, "model": model} if features else {}
        jaw |= {"features": list(gripper), "model": model} if gripper else {}
        return Contract.from_canonical(
            {"version": 1, "rate_hz": 30, "observations": {STATE: [seen]}, "action": [action, jaw]}
        )

    def _model(self, name: str, paths: list[str]) -> Any:
        from ibrobot_core.app import installed_plugins

        own = [path for path in paths if path.startswith(f"{name}.")]
        return installed_plugins().features[name].model(self.robot, own)

    def units(self, contract: Contract, norm_mode: str = "radians", calibration: Any = None) -> FeatureVectors:
        made = calibrated_units(norm_mode, contract, calibration or {}, self.document)
        assert isinstance(made, FeatureVectors)
        return made


@pytest.fixture(scope="module", params=[FIVE, SIX], ids=["five joints", "six joints"])
def arm(request, tmp_path_factory) -> Arm:
    path = write_arm(tmp_path_factory.mktemp("arm"), *request.param)
    joints = tuple(Joint(name, -1.6, 1.6, 3.0, 20.0) for name in request.param)
    groups = {"arm": request.param[:-1], "gripper": request.param[-1:]}
    return Arm(Robot("made_up", joints, groups=groups, description=Description(mjcf=path, tip="tool")))


def a_path(arm: Arm, rows: int = 12) -> Vector:
    """A smooth motion of all joints."""
    model = read_mjcf(arm.robot.description.mjcf or Path()).chain("tool", arm.robot.joint_names)
    times = np.linspace(0, 1, rows)[:, None]
    return bent(model) + 0.4 * np.sin(times * np.arange(1, len(model.joint_names) + 1))


@pytest.mark.parametrize("parts", FORMS, ids="+".join)
def test_positions_come_back_from_the_numbers_of_each_form(arm: Arm, parts: tuple[str, ...]) -> None:
    path = a_path(arm)
    units = arm.units(arm.contract(tool(parts)))
    names = tuple(name for part in parts for name in NAMES[part])
    assert arm.contract(tool(parts)).features()["action"].names == (*names, "gripper.pos")
    seen = {STATE: path[0].astype(np.float64) + 0.02}
    numbers = np.array([units({**seen, "action": row})["action"] for row in path])
    assert numbers.shape == (len(path), len(names) + 1)
    made, held = units.commands(numbers, seen, path[0])
    assert held == 0
    again = np.array([units({**seen, "action": row})["action"] for row in made])
    np.testing.assert_allclose(again, numbers, atol=1e-6)
    if len(parts) > 1:
        np.testing.assert_allclose(made, path, atol=1e-4)


@pytest.mark.parametrize("parts", FORMS, ids="+".join)
def test_equal_chunks_give_equal_positions(arm: Arm, parts: tuple[str, ...]) -> None:
    path = a_path(arm)
    units = arm.units(arm.contract(tool(parts)))
    seen = {STATE: path[0]}
    numbers = np.array([units({**seen, "action": row})["action"] for row in path])
    first, _ = units.commands(numbers, seen, path[0])
    second, _ = arm.units(arm.contract(tool(parts))).commands(numbers, seen, path[0])
    assert first.tobytes() == second.tobytes()


@pytest.mark.parametrize("parts", [form for form in FORMS if not form[0].startswith("delta")], ids="+".join)
def test_unreachable_poses_are_held_and_counted(arm: Arm, parts: tuple[str, ...]) -> None:
    path = a_path(arm, 6)
    units = arm.units(arm.contract(tool(parts)))
    numbers = np.array([units({"action": row})["action"] for row in path])
    numbers[2, :3] = [3.0, 0.0, 0.0]
    numbers[3, :3] += [0.0, 0.0, 0.9]
    made, held = units.commands(numbers, {}, path[0])
    assert held == 2
    np.testing.assert_array_equal(made[2, :-1], made[1, :-1])
    np.testing.assert_array_equal(made[3, :-1], made[1, :-1])
    np.testing.assert_array_equal(made[:, -1], numbers[:, -1])
    numbers[0, :3] = [3.0, 0.0, 0.0]
    made, held = units.commands(numbers, {}, path[0])
    assert held == 3
    np.testing.assert_array_equal(made[0, :-1], path[0, :-1])


def test_numbers_that_are_no_rotation_are_held_and_counted(arm: Arm) -> None:
    path = a_path(arm, 3)
    for turn, bad in (
        ("rotation_6d", [0.0] * 6),
        ("rotation_6d", [1.0, 0.0, 0.0, 2.0, 0.0, 0.0]),
        ("rotation_6d", [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ("quaternion", [0.0] * 4),
    ):
        units = arm.units(arm.contract(tool(("position", turn))))
        numbers = np.array([units({"action": row})["action"] for row in path])
        numbers[1, 3:-1] = bad
        made, held = units.commands(numbers, {}, path[0])
        assert held == 1, (turn, bad)
        np.testing.assert_array_equal(made[1, :-1], made[0, :-1])


@pytest.mark.parametrize("length", [1e-5, 1e5, 1e200])
def test_the_length_of_a_quaternion_turns_nothing(arm: Arm, length: float) -> None:
    """The tool is almost parallel to the base frame: what a quaternion seems to mean whose length overflows."""
    angles = {"lift": -0.6, "elbow": -0.5, "flex": 1.1 - np.pi / 2}
    start = np.array([angles.get(name, 0.0) for name in arm.robot.joint_names])
    units = arm.units(arm.contract(tool(("position", "quaternion"))))
    numbers = units({"action": start + [0.3 * (name == "roll") for name in arm.robot.joint_names]})["action"][None]
    expected, _ = units.commands(numbers, {}, start)
    numbers[:, 3:-1] *= length
    made, held = units.commands(numbers, {}, start)
    assert held == 0
    np.testing.assert_allclose(made, expected, atol=1e-9)
    numbers[:, 3:-1] = np.inf
    assert units.commands(numbers, {}, start)[1] == 1


def test_positions_stay_within_the_limits(arm: Arm) -> None:
    units = arm.units(arm.contract(tool(("position",))))
    numbers = np.array([[0.3, y, 0.1, 0.0] for y in np.linspace(-0.4, 0.4, 40)])
    made, _ = units.commands(numbers, {}, a_path(arm)[0])
    assert (made[:, :-1] >= arm.robot.lower[:-1]).all()
    assert (made[:, :-1] <= arm.robot.upper[:-1]).all()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3), st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_rotation_6d_is_orthonormal_near_its_numbers_and_exact_for_rotations(
    turn: list[float], noise: list[float]
) -> None:
    rotation = exp(np.array(turn))
    np.testing.assert_allclose(from_rotation_6d(rotation_6d(rotation)), rotation, atol=1e-12)
    made = from_rotation_6d(rotation_6d(rotation) * 3.0 + 0.2 * np.array(noise))
    np.testing.assert_allclose(made.T @ made, np.eye(3), atol=1e-12)
    assert np.linalg.det(made) > 0.999
    assert np.arccos(np.clip((np.trace(made.T @ rotation) - 1) / 2, -1, 1)) < 0.5


def test_numbers_are_those_of_each_definition(arm: Arm) -> None:
    model = read_mjcf(arm.robot.description.mjcf or Path()).chain("tool", arm.robot.joint_names)
    q = bent(model)
    tip = model.forward(q)
    wxyz, turn = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(wxyz, tip.rotation.ravel())
    mujoco.mju_quat2Vel(turn, wxyz, 1.0)
    expected = {
        "position": tip.position,
        "rotation_6d": np.concatenate([tip.rotation[:, 0], tip.rotation[:, 1]]),
        "rotation_vector": turn,
        "quaternion": np.roll(wxyz, -1) * np.sign(wxyz[0]),
    }
    for part, numbers in expected.items():
        parts = ("position",) if part == "position" else ("position", part)
        made = arm.units(arm.contract(tool(parts)))({"action": q})["action"][:-1]
        np.testing.assert_allclose(made[-len(numbers) :], numbers, atol=1e-8)


class TestDeltas:
    """Actions relative to the state of the same row."""

    CALIBRATION: Mapping[str, Any] = {"drive_mode": 0, "homing_offset": 0, "range_min": 1048, "range_max": 3048}

    @pytest.mark.parametrize("norm_mode", ["radians", "degrees", "range_m100_100"])
    def test_relative_is_absolute_minus_state(self, arm: Arm, norm_mode: str) -> None:
        names = arm.robot.joint_names
        calibration = {name: {"id": i + 1, **self.CALIBRATION} for i, name in enumerate(names)}
        deltas = arm.contract([f"delta.{name}" for name in arm.joints])
        assert deltas.features()["action"].names == (*(f"{name}.delta" for name in arm.joints), "gripper.pos")
        relative = arm.units(deltas, norm_mode, calibration)
        absolute = calibrated_units(norm_mode, arm.contract([]), calibration, arm.document)
        path = a_path(arm).astype(np.float32)
        for state, action in itertools.pairwise(path):
            row = {STATE: state, "action": action}
            plain, made = absolute(row), relative(row)
            np.testing.assert_array_equal(made[STATE], plain[STATE])
            wanted = plain["action"][:-1].astype(float) - plain[STATE][:-1].astype(float)
            np.testing.assert_allclose(made["action"][:-1], wanted, atol=2e-5)
            assert made["action"][-1] == plain["action"][-1]
            commands, held = relative.commands(made["action"][None].astype(float), {STATE: state}, state)
            assert held == 0
            np.testing.assert_allclose(
                commands[0], absolute.radians("action", plain["action"].astype(float)), atol=1e-6
            )

    @pytest.mark.parametrize("features", [["delta"], ["tool.delta_position"]])
    def test_what_is_measured_must_be_observed(self, arm: Arm, features: list[str]) -> None:
        paths = [f"delta.{name}" for name in arm.joints] if features == ["delta"] else features
        contract = arm.contract(paths, state=["tool.position"])
        with pytest.raises(
            ContractError, match=r"a relative action needs the measured positions .* position.pan is missing"
        ):
            arm.units(contract)

    def test_later_actions_of_a_chunk_are_refused(self, arm: Arm) -> None:
        units = arm.units(arm.contract([f"delta.{name}" for name in arm.joints]))
        spec = PolicySpec({}, None, len(arm.robot.joints), 1)
        units.check(spec)
        with pytest.raises(
            ContractError, match=r"pan.delta is relative .* of a chunk of 2: use a policy with one action"
        ):
            units.check(attrs.evolve(spec, chunk_size=2))
        arm.units(arm.contract(["tool.position"])).check(attrs.evolve(spec, chunk_size=2))


def test_gripper_has_the_name_that_lerobot_gives_it(arm: Arm) -> None:
    contract = arm.contract(["tool.position"], gripper=("tool.gripper",), state=["tool.position", "tool.gripper"])
    assert contract.features()["action"].names == ("ee.x", "ee.y", "ee.z", "ee.gripper_pos")
    assert contract.features()[STATE].names == ("ee.x", "ee.y", "ee.z", "ee.gripper_pos")
    names = arm.robot.joint_names
    calibration = {name: {"id": i + 1, **TestDeltas.CALIBRATION} for i, name in enumerate(names)}
    units = arm.units(contract, "degrees", calibration)
    q = a_path(arm)[0]
    row = units({STATE: np.append(np.zeros(3), q[-1]), "action": q})
    assert row["action"][-1] == pytest.approx(np.degrees(q[-1]), rel=1e-3)
    assert row[STATE][-1] == pytest.approx(np.degrees(q[-1]), rel=1e-3)
    commands, _ = units.commands(row["action"][None], {}, q)
    assert commands[0, -1] == pytest.approx(q[-1], abs=1e-12)


def test_prefix_of_real_time_chunking_has_the_form_of_the_actions(arm: Arm) -> None:
    from ibrobot_core.api import Frame

    units = arm.units(arm.contract(tool(("position", "rotation_6d"))))
    path = a_path(arm, 4)
    prefix = units.frame(Frame(0, {STATE: path[0]}, prefix=path)).prefix
    assert prefix is not None
    np.testing.assert_array_equal(prefix, [units({"action": row})["action"] for row in path])


def test_recorded_contract_needs_no_model_and_has_the_same_fingerprint(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    contract = arm.contract(tool(("position", "rotation_6d")), state=["tool.position", "position.pan"])
    canonical = contract.canonical()
    monkeypatch.setattr("ibrobot_kinematics.mjcf.read_mjcf", None)
    again = Contract.from_canonical(canonical)
    assert again.fingerprint() == contract.fingerprint()
    q = a_path(arm)[0]
    assert arm.units(again)({"action": q})["action"].tobytes() == arm.units(contract)({"action": q})["action"].tobytes()
    moved = {**canonical["action"][0], "model": _longer(canonical["action"][0]["model"])}
    other = Contract.from_canonical({**canonical, "action": [moved, canonical["action"][1]]})
    assert other.fingerprint() != contract.fingerprint(), "another arm is another contract"


def _longer(model: Any) -> Any:
    chain = model["tool"]["chains"][""]
    tip = {**chain["tip"], "position": [each + 0.01 for each in chain["tip"]["position"]]}
    return {"tool": {**model["tool"], "chains": {"": {**chain, "tip": tip}}}}


@pytest.mark.parametrize(
    "bad",
    [
        {},
        {"tool": {}},
        {"tool": {"arms": []}},
        {"tool": {"arms": [""]}},
        {"tool": {"arms": [""], "chains": {"": {"joints": 3}}}},
    ],
)
def test_damaged_model_in_a_recording_is_an_error(arm: Arm, bad: Any) -> None:
    canonical = arm.contract(["tool.position"]).canonical()
    canonical["action"][0] = {**canonical["action"][0], "model": bad}
    with pytest.raises(ContractError):
        arm.units(Contract.from_canonical(canonical))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mjcf": None}, "robot 'made_up' has no robot.description.mjcf"),
        ({"tip": "nose"}, "has no site 'nose'; it has: tool"),
        ({"mjcf": Path("nowhere.xml")}, "nowhere.xml"),
    ],
)
def test_robot_without_a_model_of_the_tool_is_an_error(arm: Arm, change: dict[str, Any], message: str) -> None:
    robot = attrs.evolve(arm.robot, description=attrs.evolve(arm.robot.description, **change))
    with pytest.raises(ContractError, match="the pose of the tool is unknown") as error:
        tool_model(robot, ["tool.position"])
    assert message in str(error.value)


@pytest.mark.parametrize("order", [("tool.gripper", "tool.position"), ("tool.position", "tool.gripper")])
def test_gripper_may_be_part_of_the_executor_of_the_arm(arm: Arm, order: tuple[str, str]) -> None:
    contract = arm.contract([])
    whole = attrs.evolve(
        contract.action_parts[0],
        joints=arm.robot.joint_names,
        features=order,
        model={"tool": tool_model(arm.robot, order)},
    )
    units = arm.units(attrs.evolve(contract, action_parts=(whole,)))
    path = a_path(arm)
    numbers = np.array([units({"action": row})["action"] for row in path])
    gripper = order.index("tool.gripper") * 3
    np.testing.assert_array_equal(numbers[:, gripper], path[:, -1])
    made, held = units.commands(numbers, {}, path[0])
    assert held == 0
    np.testing.assert_allclose([units({"action": row})["action"] for row in made], numbers, atol=1e-6)


def test_search_is_bounded_and_keeps_within_reach_of_its_start(arm: Arm) -> None:
    model = read_mjcf(arm.robot.description.mjcf or Path()).chain("tool", arm.joints)
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(100):
        start, goal = rng.uniform(-1.4, 1.4, (2, len(arm.joints)))
        near = np.clip(start + 0.05 * goal, model.lower, model.upper)
        tip = model.forward(near)
        made = follow(model, Target(tip.position, tip.rotation), start)
        ended += made is not None and float(Target(tip.position).missed(model.forward(made))[0]) < 1e-5
    assert ended >= 97


def test_search_goes_on_where_joints_do_the_same(tmp_path: Path) -> None:
    """Their normal matrix is singular but for the damping, which a long way makes small."""
    joints = [f"{kind}{i}" for i in range(2) for kind in ("turn", "rail")]
    bodies = '<body><joint name="{}" axis="0 0 1" range="-3 3"/><geom size="1"/>'
    rails = '<body pos="0.2 0.5 0.2"><joint name="{}" type="slide" axis="1 0 0" range="-9 9"/><geom size="1"/>'
    text = "".join((bodies + rails).format(*joints[i : i + 2]) for i in (0, 2))
    text += '<site name="tip" pos="0.5 0 0"/>' + "</body>" * 4
    _, model = load(tmp_path, f'<mujoco><compiler angle="radian"/><worldbody>{text}</worldbody></mujoco>', (*joints,))
    ended = 0
    for angle, start, goal in itertools.product((0.0, 0.5, 1.0), (-8.0, -2.0, 0.3), (-3.0, 0.0, 5.0)):
        tip = model.forward(np.array([angle, goal, 0.0, goal]))
        for target in (Target(tip.position), Target(tip.position, tip.rotation)):
            ended += follow(model, target, np.array([0.0, start, 0.0, start])) is not None
    assert ended > 40


def test_search_that_has_not_settled_is_no_solution(arm: Arm, monkeypatch: pytest.MonkeyPatch) -> None:
    model = read_mjcf(arm.robot.description.mjcf or Path()).chain("tool", arm.joints)
    start = bent(model)
    tip = model.forward(start + 0.3)
    target = Target(tip.position, tip.rotation)
    assert follow(model, target, start) is not None
    monkeypatch.setattr("ibrobot_kinematics.follow._ITERATIONS", 1)
    assert follow(model, target, start) is None
