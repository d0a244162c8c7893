"""Tasks in runs: steps, results, cancelling, policies, recording, and the services."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_planning.execution.requests import Numbered
from ibrobot_planning.execution.source import RESULT as MOTION_RESULT
from ibrobot_planning.tasks.reading import read_task
from ibrobot_planning.tasks.result import TaskResult
from ibrobot_planning.tasks.runner import CANCEL, CHECK, RESULT, RUN, STATUS, TaskRunner
from ibrobot_planning.world.objects import SNAPSHOT
from ibrobot_testing import SectionSuite
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.api import IbrobotError, PlanningError, String
from ibrobot_core.app import ConfigError, RequestError, Runtime

from .conftest import Make
from .test_motion import RATE_HZ, robot_yaml

REST = """
peripherals:
  - {name: eye, kind: camera, type: eye}
models: {wave: {type: wave}}
world: {scene: true, scene_when_stale: keep}
tasks: {}
contract:
  rate_hz: 20
  observations:
    - key: observation.state
      topic: /joint_states
      select: [position.pan, position.lift, position.elbow, position.flex, position.roll, position.jaw]
      align: {strategy: hold, stamp: header}
  actions:
    - {key: action, executor: arm_stream, topic: /arm/commands, type: ARRAY, safety_behavior: hold}
    - {key: action, executor: jaw_stream, topic: /jaw/commands, type: ARRAY, safety_behavior: hold}
"""
WAIT = "wait: {seconds: 0.1}"
RECORDING = "recording: {type: lines, root: ROOT, topics: contract}\n"
DOWN = "{xyz: [0.2, 0.05, 0.1], axis: down}"


def task_robot(folder: Path, *, recorded: bool = False) -> str:
    """The arm with a policy, a camera, and the objects of its scene; `recorded` with a section `recording`."""
    streams = "  arm_stream: {type: position, group: arm}\n  jaw_stream: {type: position, group: gripper}\n"
    policy = "  policy: {executors: [arm_stream, jaw_stream], inference: {model: wave}}\n"
    text = robot_yaml(folder).replace("executors:\n", f"executors:\n{streams}", 1)
    text = text.replace("control_modes:\n", f"control_modes:\n{policy}")
    rest = (
        (REST + RECORDING * recorded)
        .replace("ROOT", str(folder / "episodes"))
        .replace("ARRAY", "std_msgs/msg/Float64MultiArray")
    )
    return text + rest


@pytest.fixture
def run(start: Make, tmp_path: Path) -> Callable[..., Runtime]:
    def started(*overrides: str, recorded: bool = False, **asked: Any) -> Runtime:
        return start(*overrides, text=task_robot(tmp_path, recorded=recorded), **{"by_operator": True, **asked})

    return started


class TestTaskRunner(SectionSuite):
    @override
    def component(self, session):
        return TaskRunner(session)


def steps(*lines: str, more: str = "") -> str:
    return "\n".join([more, "steps:", *(f"  - {line}" for line in lines)])


def finish(runtime: Runtime, number: int) -> TaskResult:
    for _ in range(6000):
        runtime.step()
        result = runtime.session.bus.call(RESULT, number)
        if result is not None:
            assert isinstance(result, TaskResult)
            return result
    raise AssertionError("the task does not end")


def perform(runtime: Runtime, text: str) -> TaskResult:
    return finish(runtime, runtime.session.bus.call(RUN, text))


def joints(runtime: Runtime) -> list[float]:
    assert runtime.session.state is not None
    return runtime.session.state.position.tolist()


def test_every_kind_of_move(run):
    runtime = run()
    text = steps(
        "{name: to a pose, move: {pose: left}}",
        "move: {joints: {roll: 0.5}, speed: 0.5}",
        f"move: {DOWN}",
        "move: {xyz: [0.2, 0, 0.1]}",
        "move: {xyz: [0.2, 0, 0.1], rpy: [3.14159, 0, 0], beyond_reach: keep_axis}",
        "move: {xyz: [0.2, 0, 0.1], quaternion: [1, 0, 0, 0], beyond_reach: nearest}",
        "move: {any: [{xyz: [9, 0, 0]}, {pose: up}]}",
        f"move: {DOWN}",
        "move: {line: [{xyz: [0.2, -0.05, 0.1], axis: down}]}",
        "move: {line: [{xyz: [0, 0, 0.03], relative: true}]}",
        "move: {object: cube, xyz: [0, 0, 0.04], axis: down}",
    )
    result = perform(runtime, text)
    assert (result.success, result.message) == (True, "")
    assert [step.outcome for step in result.steps] == ["SUCCEEDED"] * 11
    assert (result.steps[0].name, result.steps[0].kind, result.steps[0].number) == ("to a pose", "move", 1)
    assert all(step.duration_s > 0 for step in result.steps)
    assert result.steps[6].facts["alternative"] == 2
    assert [result.steps[i].facts["fraction"] for i in (8, 9)] == [1.0, 1.0]
    assert result.steps[10].facts["position_error_m"] < 1e-3
    assert runtime.summary()["goals_failed"] == 0


def test_named_pose_leaves_the_gripper_alone(run):
    runtime = run()
    assert perform(runtime, steps("gripper: {position: 0.8}", "move: {pose: left}")).success
    assert joints(runtime)[:5] == pytest.approx([1.0, 0.8, 0.8, 0.5, 0.0], abs=0.05)
    assert joints(runtime)[5] == pytest.approx(0.8, abs=0.05)


def test_result_of_a_failure_names_step_code_and_obstacle(run):
    runtime = run()
    text = steps(
        "move: {pose: up}", "{name: into the cube, move: {xyz: [0.2, 0.05, 0.06], axis: down}}", "wait: {seconds: 1}"
    )
    result = perform(runtime, text)
    assert result.outcome == "FAILED"
    assert result.message.startswith("step 2 (into the cube): GOAL_IN_COLLISION: the goal is in collision")
    assert "cube" in result.message
    assert [step.outcome for step in result.steps] == ["SUCCEEDED", "FAILED", "NOT_RUN"]
    assert result.steps[1].code == "GOAL_IN_COLLISION"
    assert json.loads(json.dumps(result.as_json()))["steps"][1]["code"] == "GOAL_IN_COLLISION"


def test_hand_may_touch_what_a_step_names_and_nothing_afterwards(run):
    runtime = run()
    result = perform(runtime, steps("move: {object: cube, axis: down, touch: [cube]}"))
    assert result.success, result.message
    assert runtime.session.bus.call(SNAPSHOT, None).objects["cube"].may_touch == frozenset()


def test_gripper_that_nothing_stops_has_grasped_nothing(run):
    result = perform(run(), steps("gripper: {position: 0.8}", "gripper: {position: 0.2, grasp: cube}"))
    assert result.outcome == "FAILED"
    assert result.message == "step 2 (gripper): nothing stopped the gripper on its way to 0.2 rad: no 'cube' there"


def test_feedback_per_step(run):
    runtime = run()
    seen = runtime.session.bus.subscribe(STATUS, 100)
    perform(runtime, steps("{name: rest, wait: {seconds: 0.1}}", "wait: {seconds: 0.1}", more="name: two waits"))
    messages = [json.loads(item.message.data) for item in seen.drain() if isinstance(item.message, String)]
    assert [(m["task"], m["step"], m["steps"], m["state"]) for m in messages] == [
        ("two waits", 1, 2, "executing"),
        ("two waits", 2, 2, "executing"),
        ("two waits", 2, 2, "succeeded"),
    ]
    assert (messages[0]["kind"], messages[0]["name"]) == ("wait", "rest")


def test_alternative_whose_later_step_cannot_be_planned_is_passed_over(run):
    # From `left` the straight line would leave the reach of the arm.
    far = "move: {line: [{xyz: [0, 0.5, 0], relative: true}]}"
    runtime = run()
    other = "{move: {pose: right}}, {wait: {seconds: 0.1}}"
    text = steps(f"alternatives: [[{{move: {{pose: left}}}}, {{{far}}}], [{other}]]")
    result = perform(runtime, text)
    assert (result.success, result.steps[0].kind, result.steps[0].facts) == (True, "alternatives", {"alternative": 2})
    assert joints(runtime)[0] == pytest.approx(-1.0, abs=0.05)


def test_alternative_that_fails_gives_way_to_the_next(run):
    runtime = run()
    grasp = "gripper: {position: 0.2, grasp: cube}"
    text = steps(f"alternatives: [[{{move: {{pose: left}}}}, {{{grasp}}}], [{{{grasp}}}]]")
    result = perform(runtime, text)
    assert joints(runtime)[0] == pytest.approx(1.0, abs=0.05), "the first list began"
    nothing = "nothing stopped the gripper on its way to 0.2 rad: no 'cube' there"
    assert result.message == (
        f"step 1 (alternatives): no alternative succeeded: alternative 1: {nothing}; alternative 2: {nothing}"
    )


def test_fault_ends_all_alternatives(run):
    runtime = run()
    number = runtime.session.bus.call(RUN, steps("alternatives: [[{wait: {seconds: 5}}], [{move: {pose: left}}]]"))
    runtime.step()
    runtime.session.raise_fault("the cable is loose")
    assert finish(runtime, number).message == "step 1 (alternatives): the robot stopped: the cable is loose"


def test_cancel_slows_down_and_holds(run):
    runtime = run()
    bus = runtime.session.bus
    number = bus.call(RUN, steps("move: {pose: left}", "move: {pose: right}"))
    commands = []
    for _ in range(30):
        runtime.step()
        commands.append(runtime.session.state.command)
    bus.call(CANCEL, None)
    for _ in range(300):
        runtime.step()
        commands.append(runtime.session.state.command)
    result = bus.call(RESULT, number)
    assert (result.outcome, result.message) == ("CANCELLED", "step 1 (move): cancelled")
    assert [step.outcome for step in result.steps] == ["CANCELLED", "NOT_RUN"]
    acceleration = np.diff(np.array(commands)[:, :5], n=2, axis=0) * RATE_HZ**2
    assert np.abs(acceleration).max() <= 10.0 * 1.02
    np.testing.assert_allclose(commands[-1], commands[-100], atol=1e-9)
    assert commands[-1][0] < 0.9, "it stopped on the way"


def test_one_task_at_a_time(run):
    runtime = run()
    bus = runtime.session.bus
    number = bus.call(RUN, steps("wait: {seconds: 0.2}"))
    with pytest.raises(PlanningError, match="task 1 is running; /task/cancel ends it"):
        bus.call(RUN, steps("wait: {seconds: 1}"))
    assert finish(runtime, number).success
    assert perform(runtime, steps("wait: {seconds: 0.1}")).success
    with pytest.raises(PlanningError, match="no task 7"):
        bus.call(RESULT, 7)


def test_nothing_moves_before_the_whole_task_was_checked(run):
    runtime = run()
    before = runtime.session.state.command
    for service in (CHECK, RUN):
        with pytest.raises(ConfigError, match=r"the request:4: steps.1.move: NO_IK_SOLUTION"):
            runtime.session.bus.call(service, steps("move: {pose: left}", "move: {xyz: [2, 0, 0.1]}"))
    for _ in range(20):
        runtime.step()
    np.testing.assert_array_equal(runtime.session.state.command, before)
    assert runtime.session.bus.call(CHECK, steps("move: {pose: left}")) is None


def test_policy_runs_for_its_time_and_the_planner_takes_over_again(run):
    runtime = run()
    result = perform(runtime, steps("run_policy: {mode: policy, seconds: 0.5}", "move: {pose: up}"))
    assert result.success, result.message
    assert result.steps[0].duration_s == pytest.approx(0.5, abs=0.1)
    assert runtime.session.mode == "plan"


def test_policy_that_needs_a_prompt_is_given_it_by_the_step_alone(run, monkeypatch):
    """The mode has none."""
    make = FakePolicy.__init__

    def wants_a_prompt(self, *arguments):
        make(self, *arguments)
        self.spec = attrs.evolve(self.spec, prompt=True)

    monkeypatch.setattr(FakePolicy, "__init__", wants_a_prompt)
    runtime = run()
    with pytest.raises(ConfigError, match=r"control_modes\.policy\.inference\.prompt: is missing"):
        runtime.session.bus.call(CHECK, steps("run_policy: {mode: policy, seconds: 0.1}"))
    result = perform(runtime, steps("run_policy: {mode: policy, seconds: 0.1, prompt: pick up the cube}"))
    assert result.success, result.message


@pytest.mark.parametrize("prompt", ["", "pick up the cube"])
@pytest.mark.parametrize("before", ["plan", "policy"])
def test_policy_is_given_the_prompt_of_the_step(run, before: str, prompt: str):
    runtime = run()
    runtime.switch_mode(before)
    given = []
    service = runtime.session.bus.services()["/set_mode"]
    runtime.session.bus.unserve(service)

    def switch(request):
        given.append(request)
        return runtime.switch_mode(request.mode)

    runtime.session.bus.serve(service, switch)
    perform(runtime, steps(f"run_policy: {{mode: policy, seconds: 0.1, prompt: {prompt!r}}}"))
    entered = [("policy", prompt)] if prompt or before == "plan" else []
    assert [(each.mode, each.prompt) for each in given] == [*entered, ("plan", "")]


def test_policy_without_success_fails_the_step(run):
    result = perform(run(), steps("run_policy: {mode: policy, seconds: 0.3, until: success}"))
    assert result.message == "step 1 (run_policy): no success within 0.3 s"


@pytest.mark.parametrize(("until", "outcome", "succeeded"), [("time", "success", True), ("success", "failure", False)])
def test_policy_is_recorded_as_an_episode(run, tmp_path, until: str, outcome: str, succeeded: bool):
    pytest.importorskip("ibrobot_data")
    runtime = run(recorded=True)
    policy = f"run_policy: {{mode: policy, seconds: 1, until: {until}}}"
    result = perform(runtime, steps("record: {prompt: wave, outcome: success}", policy))
    assert result.success == succeeded, result.message
    runtime.stop()
    (metadata,) = (tmp_path / "episodes").rglob("metadata.json")
    assert json.loads(metadata.read_text())["outcome"] == outcome
    assert runtime.summary()["episodes"] == 1


def test_look_reports_objects_and_waits_for_images(run):
    runtime = run()
    text = steps(
        "look: {object: cube}",
        "look: {camera: eye}",
        "look: {object: cube, near: post, within: 0.5}",
        "look: {object: cube, near: ball, within: 0.1}",
    )
    result = perform(runtime, text)
    assert result.steps[0].facts == {"position_m": [0.2, 0.05, 0.06]}
    assert result.steps[1].facts["topic"] == "/camera/eye/image_raw"
    assert result.steps[2].facts["distance_m"] == pytest.approx(0.3227, abs=1e-3)
    assert result.message == "step 4 (look): 'cube' is 0.400 m from 'ball'; at most 0.1 m asked"


def test_end_of_the_run_cancels_the_task(run):
    runtime = run()
    runner = next(each for each in runtime.plan.components if isinstance(each, TaskRunner))
    number = runner.run(read_task(steps("move: {pose: left}"), "file.yaml"))
    for _ in range(20):
        runtime.step()
    assert runner.line() == "file: step 1/1, move"
    runtime.stop()
    result = runner.result(number)
    assert result is not None
    assert (result.outcome, result.message) == ("CANCELLED", "step 1 (move): the run ended")


def test_end_of_a_run_in_real_time_lets_the_robot_slow_down(run):
    runtime = run(lockstep=False)
    session = runtime.session
    states = session.bus.subscribe("/joint_states", 1)
    number = session.bus.call(RUN, steps("move: {joints: {pan: 1.8}, speed: 0.1}"))
    runner = next(each for each in runtime.plan.components if isinstance(each, TaskRunner))
    begun = session.state.command[0]
    while session.state.command[0] - begun < 0.2:
        assert states.get(10.0) is not None
    runtime.stop()
    result = runner.result(number)
    assert result is not None
    assert (result.outcome, result.message) == ("CANCELLED", "step 1 (move): the run ended")
    assert 0.2 < session.state.command[0] - begun < 1.5, "it did not reach the goal"


def test_fault_fails_the_step(run):
    runtime = run()
    number = runtime.session.bus.call(RUN, steps("wait: {seconds: 5}"))
    runtime.step()
    runtime.session.raise_fault("the cable is loose")
    result = finish(runtime, number)
    assert result.message == "step 1 (wait): the robot stopped: the cable is loose"


def stop_and_reset(runtime: Runtime) -> None:
    """An emergency stop and a reset at once, as soon as the robot may be reset, unseen by polls of the task."""
    runner = next(each for each in runtime.plan.components if isinstance(each, TaskRunner))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "work", lambda timeout_s: None)
        runtime.session.emergency_stop()
        for _ in range(300):
            runtime.step()
            try:
                runtime.reset()
            except IbrobotError:
                continue
            return
    raise AssertionError("no reset")


STILL = 0.03
"""A reset lets the command go to where the arm is measured [rad]."""
FIRST = {
    "left": "move: {pose: left}",
    "wait": "wait: {seconds: 0.2}",
    "grip": "gripper: {position: 1.0}",
    "policy": "run_policy: {mode: policy, seconds: 0.2}",
    "alternatives": "alternatives: [[{move: {pose: left}}], [{move: {pose: right}}]]",
}


@pytest.mark.parametrize("polls", [0, 1, 5])
@pytest.mark.parametrize("first", FIRST)
def test_stop_and_reset_between_two_polls_end_the_task(run, first: str, polls: int):
    runtime = run()
    number = runtime.session.bus.call(RUN, steps(FIRST[first], "move: {pose: right}"))
    for _ in range(polls):
        runtime.step()
    stop_and_reset(runtime)
    before = runtime.session.state.command
    result = finish(runtime, number)
    assert result.outcome == "FAILED"
    assert result.message.endswith("the robot stopped: an emergency stop"), result.message
    for _ in range(100):
        runtime.step()
    np.testing.assert_allclose(runtime.session.state.command, before, atol=STILL)


def test_stop_and_reset_before_the_next_step_begins(run):
    """The motion had ended before the stop: its result is a success, and the next step must not follow."""
    runtime = run()
    bus = runtime.session.bus
    number = bus.call(RUN, steps("move: {pose: left}", "move: {pose: right}"))
    runtime.step()
    while bus.call(MOTION_RESULT, Numbered(1)) is None:
        runtime.step()
    stop_and_reset(runtime)
    before = runtime.session.state.command
    result = finish(runtime, number)
    assert [each.outcome for each in result.steps] == ["SUCCEEDED", "FAILED"]
    assert result.message == "step 2 (move): the robot stopped: an emergency stop"
    for _ in range(100):
        runtime.step()
    np.testing.assert_allclose(runtime.session.state.command, before, atol=STILL)


def test_stop_and_reset_while_a_task_is_checked(run, monkeypatch: pytest.MonkeyPatch):
    runtime = run()
    runner = next(each for each in runtime.plan.components if isinstance(each, TaskRunner))
    check = runner._checked

    def slow(file: Any) -> Any:
        checked = check(file)
        stop_and_reset(runtime)
        return checked

    monkeypatch.setattr(runner, "_checked", slow)
    number = runtime.session.bus.call(RUN, steps("move: {pose: left}"))
    before = runtime.session.state.command
    assert finish(runtime, number).message == "step 1 (move): the robot stopped: an emergency stop"
    np.testing.assert_allclose(runtime.session.state.command, before, atol=STILL)


def test_requests_read_nothing_of_the_environment(run, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("IBROBOT_PASSWORD", "hunter2")
    runtime = run()
    for step in ('move: {pose: "${IBROBOT_PASSWORD}"}', 'move: {pose: "\\u0024{IBROBOT_PASSWORD}"}'):
        for service in (CHECK, RUN):
            with pytest.raises(ConfigError, match="IBROBOT_PASSWORD") as refused:
                runtime.session.bus.call(service, steps(step))
            assert "hunter2" not in str(refused.value)


def test_long_tasks_are_refused(run):
    runtime = run()
    with pytest.raises(ConfigError, match="steps: a task has 1 to 200 steps, got 201"):
        runtime.session.bus.call(RUN, steps(*["wait: {seconds: 0.1}"] * 201))
    with pytest.raises(RequestError, match=r"/task/run: a text of \d+ characters, at most 20000 are allowed"):
        runtime.session.bus.call(RUN, steps(*["wait: {seconds: 0.1}"] * 2000))
