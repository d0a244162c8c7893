"""Chunks of the model that acts, for those who speak ROS."""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from typing import Any

import attrs
import numpy as np
import pytest
from ibrobot_ros2.inference import DISPATCH_INFER, InferRequest, InferResult, serve_chunks
from ibrobot_ros2.interfaces import action_type, from_cdr, to_cdr
from ibrobot_ros2.services import plain
from ibrobot_testing.section import make_session

from ibrobot_core.api import MODEL_ANSWERS, Header, IbrobotError, ModelAnswer, NotSupported, PolicyError

PATIENCE_S = 10.0


def answer(observed_ns: int, actions: Any = ((1.0, 2.0), (3.0, 4.0)), **fields: Any) -> ModelAnswer:
    values = np.array(actions, dtype=float).ravel()
    made = ModelAnswer(
        Header(observed_ns + 9), request=3, observed_ns=observed_ns, model="net", server="", weights="", prompt="pick",
        outcome="used", error="", latency_ms=12.5, infer_ms=10.0, queue_ms=0.0, step_ns=50_000_000,
        joint_names=("a", "b"), actions=values,
    )  # fmt: skip
    return attrs.evolve(made, **fields)


@attrs.define
class Robot:
    session: Any = attrs.field(factory=make_session)
    answers: queue.SimpleQueue[InferResult | IbrobotError] = attrs.field(factory=queue.SimpleQueue)

    def ask(self, **fields: Any) -> None:
        """Ask in another thread, and wait until it listens."""
        request, bus = InferRequest(**fields), self.session.bus

        def call() -> None:
            try:
                self.answers.put(bus.call(DISPATCH_INFER, request))
            except IbrobotError as error:
                self.answers.put(error)

        threading.Thread(target=call, daemon=True).start()
        pause = threading.Event()
        for _ in range(1000):
            if bus.has_subscribers(MODEL_ANSWERS):
                return
            pause.wait(0.01)
        raise AssertionError("it does not listen")

    def publish(self, message: ModelAnswer) -> None:
        self.session.bus.publish(MODEL_ANSWERS, message)

    def take(self) -> InferResult | IbrobotError:
        return self.answers.get(timeout=PATIENCE_S)


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    made.session.acting = object()
    end = serve_chunks(made.session)
    yield made
    end()


def test_the_first_answer_for_late_enough_observations_is_the_result(robot: Robot):
    robot.ask(obs_timestamp_ns=100)
    robot.publish(answer(99))
    robot.publish(answer(100))
    result = robot.take()
    assert isinstance(result, InferResult)
    assert (result.chunk_size, result.success, result.inference_latency_ms) == (2, True, 12.5)
    assert result.message == "net, observed at 100, a, b"
    kind = f"{action_type(DISPATCH_INFER.ros_type).name}_Result"
    (variant,) = from_cdr(kind, to_cdr(kind, plain(result)))["action_chunk"]["variants"]
    assert (variant["key"], variant["type"]) == ("action", "float_64_array")
    assert [each["size"] for each in variant["float_64_array"]["layout"]["dim"]] == [2, 2]
    assert variant["float_64_array"]["data"] == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("fields", "message", "kind", "why"),
    [
        ({}, answer(5, (), error="no chunk within 5 s"), PolicyError, "no chunk within 5 s"),
        ({"prompt": "place"}, answer(5), NotSupported, "the model has the prompt 'pick'; a goal cannot change it"),
    ],
)
def test_failures_and_other_prompts_are_errors(
    robot: Robot, fields: dict[str, Any], message: ModelAnswer, kind: type[IbrobotError], why: str
):
    robot.ask(**fields)
    robot.publish(message)
    error = robot.take()
    assert isinstance(error, kind)
    assert why in str(error)


def test_it_ends_with_the_mode(robot: Robot):
    robot.ask()
    robot.session.acting = None
    assert isinstance(robot.take(), PolicyError)
    with pytest.raises(NotSupported, match="no model acts in mode"):
        robot.session.bus.call(DISPATCH_INFER)


def test_two_who_speak_ros_serve_it_once(robot: Robot):
    serve_chunks(robot.session)()
    assert robot.session.bus.serves(DISPATCH_INFER), "it is the other's"
