"""Services that take their time, as actions."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from typing import Any

import attrs
import pytest
from ibrobot_ros2.calls import Calls, GoalRequest
from ibrobot_testing.section import make_session

from ibrobot_core.api import RecorderError
from ibrobot_core.app import NoRequest, Service

PATIENCE_S = 10.0


@attrs.frozen
class Task:
    prompt: str = ""
    from_ns: int = 0


@attrs.frozen
class Done:
    success: bool
    message: str


@attrs.frozen
class Progress:
    percent: int


PROGRESS = Service("/task/progress", NoRequest, Progress)
CANCEL = Service("/task/cancel", NoRequest, type(None))
TASK = Service("/task", Task, Done, ros_type="made_up/action/Task", progress=PROGRESS, cancel=CANCEL)


class Client:
    """What speaks to clients."""

    def __init__(self) -> None:
        self.heads: list[Any] = []
        self.changed = threading.Condition()

    def offer(self, name: str, type_name: str, *, executor: str = "", service: str = "") -> None:
        self._note("action", name=name, type=type_name, service=service)

    def feed(self, goal: int, values: Mapping[str, Any]) -> None:
        self._note("feedback", values=values)

    def end(self, goal: int, state: str, values: Mapping[str, Any]) -> None:
        self._note("ended", state=state, values=values)

    def _note(self, op: str, **head: Any) -> None:
        with self.changed:
            self.heads.append({"op": op, **head})
            self.changed.notify_all()

    def take(self, op: str) -> dict[str, Any]:
        """The next head of a kind; others before it stay."""
        with self.changed:
            assert self.changed.wait_for(lambda: any(head["op"] == op for head in self.heads), PATIENCE_S), self.heads
            found: dict[str, Any] = next(head for head in self.heads if head["op"] == op)
            self.heads.remove(found)
            return found


class Robot:
    """A run with a task that ends only on request."""

    def __init__(self) -> None:
        self.session = make_session()
        self.bus = self.session.bus
        self.asked: list[Task] = []
        self.end = threading.Event()
        self.answer: Done | Exception = Done(True, "done")
        self.bus.serve(TASK, self._perform)
        self.bus.serve(PROGRESS, lambda _: Progress(40))
        self.bus.serve(CANCEL, lambda _: self.end.set())
        self.calls = Calls(self.session, lambda name: name != "/hidden", lambda name: f"/lab{name}", "test")
        self.client = Client()

    def _perform(self, task: Task) -> Done:
        self.asked.append(task)
        assert self.end.wait(PATIENCE_S)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def send(self, number: int = 1, fields: Mapping[str, Any] | None = None) -> bool:
        return self.calls.take_goal(self.client, GoalRequest(number, fields or {}, service="/task"))

    def ended(self) -> tuple[str, dict[str, Any]]:
        head = self.client.take("ended")
        return head["state"], head["values"]


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    made.end.set()
    made.calls.close()


def test_only_what_is_offered_is_declared_once(robot: Robot):
    robot.bus.serve(attrs.evolve(TASK, name="/hidden"), lambda _: Done(True, ""))
    robot.calls.declare(robot.client)
    robot.calls.refresh(robot.client)
    assert robot.client.heads == [
        {"op": "action", "name": "/lab/task", "type": "made_up/action/Task", "service": "/task"}
    ]
    robot.bus.serve(attrs.evolve(TASK, name="/later"), lambda _: Done(True, ""))
    robot.calls.refresh(robot.client)
    assert robot.client.heads[1]["name"] == "/lab/later", "a mode has brought it"


def test_a_goal_has_feedback_and_the_answer_as_its_result(robot: Robot):
    assert robot.send(fields={"prompt": "pick", "from": {"sec": 2, "nanosec": 3}})
    assert robot.client.take("feedback")["values"] == {"percent": 40}
    assert robot.asked == [Task("pick", 2_000_000_003)]
    robot.end.set()
    assert robot.ended() == ("succeeded", {"success": True, "message": "done"})


def test_a_canceled_goal_ends_as_canceled_with_its_answer(robot: Robot):
    robot.send()
    assert robot.calls.cancel(robot.client, 1)
    assert robot.ended() == ("canceled", {"success": True, "message": "done"})
    assert not robot.calls.cancel(robot.client, 1), "it has ended"


def test_a_cancel_that_the_service_refuses_leaves_the_goal(robot: Robot):
    def refuse(_: object) -> None:
        raise RecorderError("not now")

    robot.bus.unserve(CANCEL)
    robot.bus.serve(CANCEL, refuse)
    robot.send()
    assert not robot.calls.cancel(robot.client, 1)
    robot.end.set()
    assert robot.ended()[0] == "succeeded"


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (Done(False, "discarded"), "discarded"),
        (RecorderError("the disk is full"), "the disk is full"),
        (ValueError("a bug"), "the service failed; the robot's log has the cause"),
    ],
)
def test_errors_and_failures_abort_a_goal(robot: Robot, answer: Done | Exception, message: str):
    robot.answer = answer
    robot.send()
    robot.end.set()
    assert robot.ended() == ("aborted", {"success": False, "message": message})


def test_a_request_that_does_not_fit_aborts_its_goal(robot: Robot):
    robot.send(fields={"promt": "pick"})
    state, values = robot.ended()
    assert (state, "did you mean 'prompt'" in values["message"]) == ("aborted", True)


def test_too_many_goals_and_gone_services_are_rejected(robot: Robot):
    assert [robot.send(number) for number in range(9)] == [True] * 8 + [False]
    robot.bus.unserve(TASK)
    assert not robot.send(9)
