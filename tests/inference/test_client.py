"""Inference clients in the host: who waits for whom, resets in their place, a hanging policy does not keep the host."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.errors import PolicyError
from ibrobot_core.inference import client as module
from ibrobot_core.inference.client import (
    Chunk,
    DispatchInfer,
    EngineClient,
    InferenceClient,
    LocalEngine,
    LockstepClient,
)
from ibrobot_core.interfaces import Frame

PATIENCE_S = 30.0


class GatedPolicy(FakePolicy):
    """Notes its calls; `infer` waits for the gate."""

    def __init__(self) -> None:
        super().__init__(host_context())
        self.calls: list[str] = []
        self.running = 0
        self.most = 0
        self.entered = threading.Semaphore(0)
        self.gate = threading.Semaphore(0)
        self.error: Exception | None = None

    def reset(self, seed: int) -> None:
        self.calls.append(f"reset {seed}")
        if seed < 0:
            raise ValueError("seed must not be negative")

    def infer(self, tensors):
        self.running += 1
        self.most = max(self.most, self.running)
        self.calls.append(f"infer {tensors['state'][0]:g}")
        self.entered.release()
        assert self.gate.acquire(timeout=PATIENCE_S)
        self.running -= 1
        if self.error is not None:
            raise self.error
        return super().infer(tensors)


def request(number: int) -> DispatchInfer:
    return DispatchInfer(number, Frame(1000 + number, {"observation.state": np.full(6, number, np.float32)}))


@pytest.fixture
def policy() -> GatedPolicy:
    return GatedPolicy()


@pytest.fixture
def monolithic(policy: GatedPolicy) -> Iterator[EngineClient]:
    client = EngineClient(policy)
    yield client
    policy.gate.release(100)
    client.close()


class ReusesItsChunk(FakePolicy):
    def __init__(self) -> None:
        super().__init__(host_context())
        self._chunk = np.zeros((10, 6))

    def postprocess(self, tensors):
        self._chunk[:] = super().postprocess(tensors)
        return self._chunk


def test_chunk_is_not_overwritten_by_the_next():
    client = LockstepClient(ReusesItsChunk())
    actions: list[np.ndarray] = []
    for number in (1, 2):
        client.submit(request(number))
        chunk = client.poll()
        assert chunk is not None
        assert chunk.actions is not None
        actions.append(chunk.actions)
    assert not np.array_equal(actions[0], actions[1])


def test_the_answer_carries_the_id_and_the_observations_time(policy: GatedPolicy, monolithic: EngineClient):
    monolithic.submit(request(3))
    assert monolithic.poll() is None, "submit does not wait for the policy"
    policy.gate.release()
    chunk = monolithic.poll(PATIENCE_S)
    assert chunk is not None
    assert (chunk.id, chunk.start_ns, chunk.error) == (3, 1003, "")
    assert chunk.actions is not None
    assert chunk.actions.shape == (10, 6)
    assert monolithic.poll() is None


def test_the_policy_never_runs_twice_at_once_and_only_the_newest_of_those_waiting_runs(
    policy: GatedPolicy, monolithic: EngineClient
):
    monolithic.submit(request(1))
    assert policy.entered.acquire(timeout=PATIENCE_S)
    for number in (2, 3, 4):
        monolithic.submit(request(number))
    policy.gate.release(2)
    answers = [monolithic.poll(PATIENCE_S), monolithic.poll(PATIENCE_S)]
    assert [chunk and chunk.id for chunk in answers] == [1, 4]
    assert policy.calls == ["infer 1", "infer 4"]
    assert policy.most == 1


def test_the_policy_is_reset_before_it_sees_a_later_request(policy: GatedPolicy, monolithic: EngineClient):
    monolithic.submit(request(1))
    assert policy.entered.acquire(timeout=PATIENCE_S)
    monolithic.submit(request(2))
    monolithic.reset(5)
    monolithic.submit(request(3))
    policy.gate.release(2)
    answers = [monolithic.poll(PATIENCE_S), monolithic.poll(PATIENCE_S)]
    assert [chunk and chunk.id for chunk in answers] == [1, 3]
    assert policy.calls == ["infer 1", "reset 5", "infer 3"]


class FarEngine(LocalEngine):
    """Takes three requests at a time; `model_ms` of each are the model's."""

    parallel = 3

    def __init__(self, policy: FakePolicy, model_ms: float, queue_ms: float = 0.0) -> None:
        super().__init__(policy)
        self._times_ms = model_ms, queue_ms

    def run(self, tensors, request_id, deadline_ns):
        outputs = super().run(tensors, request_id, deadline_ns)
        self.stats.model_ms, self.stats.queue_ms = self._times_ms
        self.stats.pace_ms = 750.0
        return outputs


def test_a_far_model_is_asked_several_times_at_once_and_reset_in_between(policy: GatedPolicy):
    client = EngineClient(policy, FarEngine(policy, 0.0))
    try:
        for number in (1, 2, 3):
            client.submit(request(number))
            assert policy.entered.acquire(timeout=PATIENCE_S)
        for number in (4, 5):
            client.submit(request(number))
        client.reset(7)
        client.submit(request(6))
        assert not policy.entered.acquire(timeout=0.01)
        policy.gate.release(4)
        answers = [client.poll(PATIENCE_S) for _ in range(4)]
        assert sorted(chunk.id for chunk in answers if chunk) == [1, 2, 3, 6]
        assert policy.calls[:3] == ["infer 1", "infer 2", "infer 3"]
        assert policy.calls[3:] == ["reset 7", "infer 6"]
        assert policy.most == 3
    finally:
        policy.gate.release(100)
        client.close()


def test_one_request_takes_one_thread(policy: GatedPolicy):
    before = set(threading.enumerate())
    client = EngineClient(policy, FarEngine(policy, 0.0))
    policy.gate.release()
    client.submit(request(1))
    assert client.poll(PATIENCE_S) is not None
    assert len(set(threading.enumerate()) - before) == 1
    client.close()


def test_nothing_overtakes_a_reset_that_takes_long(policy: GatedPolicy, monkeypatch: pytest.MonkeyPatch):
    begun, go_on = threading.Event(), threading.Event()

    def reset(seed):
        begun.set()
        assert go_on.wait(PATIENCE_S)
        policy.calls.append("reset")

    monkeypatch.setattr(policy, "reset", reset)
    policy.gate.release(100)
    client = EngineClient(policy, FarEngine(policy, 0.0))
    client.reset(7)
    assert begun.wait(PATIENCE_S)
    client.submit(request(1))
    assert client.poll(0.01) is None
    go_on.set()
    assert client.poll(PATIENCE_S) is not None
    assert policy.calls == ["reset", "infer 1"]
    client.close()


@pytest.mark.parametrize(("model_ms", "queue_ms", "parallel"), [(1e-6, 0.0, 3), (1e9, 0.0, 1), (1e-6, 1e9, 1)])
def test_what_waits_at_the_model_gains_nothing_by_company(
    policy: GatedPolicy, model_ms: float, queue_ms: float, parallel: int
):
    client = EngineClient(policy, FarEngine(policy, model_ms, queue_ms))
    assert client.parallel == 3, "as long as nothing is known"
    policy.gate.release(100)
    client.submit(request(1))
    chunk = client.poll(PATIENCE_S)
    assert chunk is not None
    assert (chunk.queued_ns, chunk.pace_ns) == (queue_ms * 1e6, 750_000_000)
    assert client.parallel == parallel
    client.close()


def test_the_model_that_came_back_is_reported(policy: GatedPolicy):
    engine = FarEngine(policy, 0.0)
    client = EngineClient(policy, engine)
    engine.stats.restarts += 1
    assert client.returns == 1
    client.close()


def test_closing_returns_while_the_policy_hangs(policy: GatedPolicy, monkeypatch: pytest.MonkeyPatch):
    client = EngineClient(policy)
    client.submit(request(1))
    assert policy.entered.acquire(timeout=PATIENCE_S)
    monkeypatch.setattr(module, "_CLOSE_TIMEOUT_S", 0.01)
    client.submit(request(2))
    client.close()
    client.close()
    assert policy.running == 1, "it still hangs"
    policy.gate.release()
    assert client.poll(PATIENCE_S) is not None
    monkeypatch.setattr(module, "_CLOSE_TIMEOUT_S", PATIENCE_S)
    client.close()
    assert policy.calls == ["infer 1"], "what waited behind is never run"


def test_a_reset_that_fails_is_reported_at_the_next_poll(policy: GatedPolicy, monolithic: EngineClient, caplog):
    with caplog.at_level(logging.CRITICAL):
        monolithic.reset(-1)
        with pytest.raises(PolicyError, match="reset failed: ValueError: seed must not be negative"):
            monolithic.poll(PATIENCE_S)


def test_lockstep_answers_within_submit(policy: GatedPolicy):
    client = LockstepClient(policy)
    policy.gate.release()
    client.submit(request(1))
    chunk = client.poll()
    assert chunk is not None
    assert (chunk.id, chunk.start_ns) == (1, 1001)
    assert client.poll() is None


@pytest.mark.parametrize("end", [lambda client: client.reset(2), lambda client: client.close()], ids=["reset", "close"])
def test_lockstep_forgets_an_answer_at_reset_and_close(policy: GatedPolicy, end: Callable[[InferenceClient], None]):
    client = LockstepClient(policy)
    policy.gate.release()
    client.submit(request(1))
    end(client)
    assert client.poll() is None


@pytest.mark.parametrize("kind", [LockstepClient, EngineClient])
def test_a_policy_that_raises_answers_with_its_error(kind: type[InferenceClient], policy: GatedPolicy, caplog):
    policy.error = RuntimeError("out of memory")
    policy.gate.release()
    assert _answer(kind, policy).error == "RuntimeError: out of memory"
    assert "the policy failed" in caplog.text


@pytest.mark.parametrize("kind", [LockstepClient, EngineClient])
@pytest.mark.parametrize("actions", [{"action": 1}, "nonsense", [[1, 2], [3]]], ids=["mapping", "text", "ragged"])
def test_a_policy_that_gives_no_numbers_answers_with_an_error(
    kind: type[InferenceClient], policy: GatedPolicy, actions: object, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(policy, "postprocess", lambda tensors: actions)
    policy.gate.release()
    chunk = _answer(kind, policy)
    assert chunk.actions is None
    assert chunk.error.startswith(("TypeError: ", "ValueError: "))


def _answer(kind: type[InferenceClient], policy: GatedPolicy) -> Chunk:
    client = kind(policy)  # type: ignore[call-arg]
    try:
        client.submit(request(1))
        chunk = client.poll(PATIENCE_S)
    finally:
        client.close()
    assert chunk is not None
    assert chunk.id == 1
    return chunk


class NotFinite(FakePolicy):
    """Returns a number that is not finite from one of its steps."""

    def __init__(self, stage: str, value: float) -> None:
        super().__init__(host_context())
        self._stage, self._value = stage, value

    def _spoiled(self, stage: str, array):
        array = np.array(array, np.float64)
        if stage == self._stage:
            array.flat[-1] = self._value
        return array

    def preprocess(self, frame):
        return {name: self._spoiled("preprocess", array) for name, array in super().preprocess(frame).items()}

    def infer(self, tensors):
        return {name: self._spoiled("infer", array) for name, array in super().infer(tensors).items()}

    def postprocess(self, tensors):
        return self._spoiled("postprocess", super().postprocess(tensors))


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(("preprocess", "infer", "postprocess")), st.sampled_from((np.nan, np.inf, -np.inf)))
def test_number_that_is_not_finite_is_an_error_of_its_stage(stage: str, value: float):
    client = LockstepClient(NotFinite(stage, value))
    client.submit(request(1))
    chunk = client.poll()
    assert chunk is not None
    assert chunk.actions is None
    assert chunk.error.startswith(f"the policy's {stage}: ")
    assert chunk.error.endswith(f"is {value}, must be finite")


def test_observation_that_is_not_finite_is_named():
    frame = Frame(1, {"state": np.array([0.0, np.nan], np.float32)})
    with pytest.raises(PolicyError, match=r"the observation: state\[1\] is nan, must be finite"):
        frame.observation("state", (2,))
