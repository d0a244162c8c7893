"""The cloud side and its clients within one process: batches, turns, deadlines, one model, many robots."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from types import MappingProxyType, SimpleNamespace
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_serve import service as module
from ibrobot_serve.metrics import probes
from ibrobot_serve.pacing import Pacing
from ibrobot_serve.remote import RemoteEngine
from ibrobot_serve.service import InferenceService, ServiceOptions
from ibrobot_serve.wire import (
    WireDecoder,
    WireEncoder,
    WireKind,
    WireMessage,
    health_name,
    offer_name,
    server_name,
    service_name,
)
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy, FakeTransport
from prometheus_client.parser import text_string_to_metric_families

from ibrobot_core.api import (
    ContractError,
    Handler,
    PolicyError,
    Tensors,
    TransportError,
)

PATIENCE_S = 30.0
SOON_NS = round(PATIENCE_S * 1e9)


class Net(FakePolicy):
    """Doubles `x`; each batch waits for the gate."""

    def __init__(self, *, stateful: bool = False) -> None:
        super().__init__(host_context())
        self.spec = attrs.evolve(self.spec, stateful=stateful)
        self.batches: list[list[float]] = []
        self.seeds: list[int] = []
        self.entered = threading.Semaphore(0)
        self.gate = threading.Semaphore(0)

    @override
    def reset(self, seed: int) -> None:
        self.seeds.append(seed)
        if seed < 0:
            raise ValueError("a negative seed")

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        return {"twice": np.where(tensors["x"] == 17, np.inf, tensors["x"] * 2)}

    @override
    def infer_batch(self, batch: Any) -> list[Tensors]:
        self.batches.append([float(tensors["x"].ravel()[0]) for tensors in batch])
        self.entered.release()
        assert self.gate.acquire(timeout=PATIENCE_S)
        if any((tensors["x"] == 13).any() for tensors in batch):
            raise ValueError("thirteen")
        return super().infer_batch(batch)


class OneOutput(Net):
    """Writes every answer into the same array, as a network does whose outputs are allocated once."""

    def __init__(self) -> None:
        super().__init__()
        self._output = np.zeros(1)

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        np.multiply(tensors["x"], 2, out=self._output)
        return MappingProxyType({"twice": self._output})  # which `copy.deepcopy` refuses


class OneBatchOfOutputs(Net):
    """As `OneOutput`, with a row for each request of a batch."""

    def __init__(self) -> None:
        super().__init__()
        self._outputs = np.zeros((8, 1))

    @override
    def infer_batch(self, batch: Any) -> list[Tensors]:
        for row, each in zip(self._outputs, super().infer_batch(batch), strict=False):
            row[:] = each["twice"]
        return [{"twice": row} for row in self._outputs[: len(batch)]]


class Cloud:
    """A service with its transport, and robots that ask it in threads of their own."""

    def __init__(
        self, policy: Net, options: ServiceOptions | None = None, transport: FakeTransport | None = None
    ) -> None:
        self.policy = policy
        self.transport = transport or FakeTransport()
        self.hung = threading.Event()
        self.service = InferenceService(policy, self.transport, "net", options, on_hang=self.hung.set)
        self.service.start()
        self.pool = ThreadPoolExecutor(80)

    def ask(self, robot: str, x: Any, *, wait_ns: int = SOON_NS, **changes: Any) -> Future[WireMessage]:
        """Send a request; its answer comes later."""
        message = WireMessage(
            WireKind.REQUEST,
            5,
            {"x": np.atleast_1d(np.asarray(x, np.float64))},
            robot,
            self.policy.fingerprint(),
            deadline_ns=wait_ns,
        )
        return self.send(bytes(WireEncoder().encode(attrs.evolve(message, **changes))))

    def send(self, payload: bytes) -> Future[WireMessage]:
        return self.pool.submit(
            lambda: WireDecoder().decode(self.transport.request(service_name("net"), payload, PATIENCE_S))
        )

    def asked(self, robot: str, x: Any, **changes: Any) -> Future[WireMessage]:
        """As `ask`; returns once the request waits for its turn."""
        before = self.health()["waiting"]
        future = self.ask(robot, x, **changes)
        self.until(lambda: self.health()["waiting"] > before)
        return future

    def busy(self) -> Future[WireMessage]:
        """A request that keeps the model busy until the gate opens."""
        future = self.ask("busy", 0)
        assert self.policy.entered.acquire(timeout=PATIENCE_S)
        return future

    def health(self) -> dict[str, Any]:
        health = json.loads(bytes(self.transport.request(health_name("net"), b"", PATIENCE_S)))
        assert isinstance(health, dict)
        return health

    @staticmethod
    def until(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        pause = threading.Event()
        while not condition():
            assert time.monotonic() < deadline
            pause.wait(0.002)

    def close(self) -> None:
        self.policy.gate.release(1000)
        self.service.close()
        self.service.close()
        self.pool.shutdown()
        self.transport.close()


@contextmanager
def served(policy: Net | None = None, **options: Any) -> Iterator[Cloud]:
    cloud = Cloud(policy or Net(), ServiceOptions(**options))
    try:
        yield cloud
    finally:
        cloud.close()


def outputs(future: Future[WireMessage]) -> list[float]:
    message = future.result(PATIENCE_S)
    assert message.kind is WireKind.ANSWER, message.text
    twice: list[float] = message.tensors["twice"].tolist()
    return twice


def failure(future: Future[WireMessage]) -> str:
    """Why the request failed; `refused: ` before it if another server should be asked."""
    message = future.result(PATIENCE_S)
    assert message.kind in (WireKind.FAILURE, WireKind.REFUSAL)
    return f"refused: {message.text}" if message.kind is WireKind.REFUSAL else message.text


def test_waiting_requests_are_batched_up_to_the_limit():
    with served(batch=3) as cloud:
        first = cloud.busy()
        futures = [cloud.asked(f"robot {i}", i) for i in range(1, 5)]
        cloud.policy.gate.release(3)
        assert [outputs(future) for future in futures] == [[2], [4], [6], [8]]
        assert outputs(first) == [0]
        assert cloud.policy.batches == [[0], [1, 2, 3], [4]]
        assert cloud.health()["batches"] == {"1": 2, "3": 1}


@pytest.fixture
def model_runs_on() -> Iterator[None]:
    """The model's thread begins the next batch before any other thread can encode the answers of the last."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(10.0)
    yield
    sys.setswitchinterval(before)


@pytest.mark.parametrize("policy", [OneOutput, OneBatchOfOutputs])
def test_fleet_gets_its_own_answers_of_a_policy_that_reuses_its_outputs(policy: type[Net], model_runs_on: None):
    with served(policy(), batch=4) as cloud:
        first = cloud.busy()
        futures = [cloud.asked(f"robot {i}", i) for i in range(1, 9)]
        cloud.policy.gate.release(3)
        assert [outputs(future) for future in futures] == [[2 * i] for i in range(1, 9)]
        assert outputs(first) == [0]
        assert cloud.policy.batches == [[0], [1, 2, 3, 4], [5, 6, 7, 8]]


def test_the_newest_request_of_a_robot_takes_the_place_of_one_that_waits():
    with served(batch=1) as cloud:
        cloud.busy()
        older = cloud.asked("greedy", 20)
        others = [cloud.asked(f"robot {i}", i) for i in (1, 2)]
        newer = cloud.ask("greedy", 21, id=6)
        assert failure(older) == "dropped: replaced by the newer request 6 of this robot"
        cloud.policy.gate.release(10)
        assert [outputs(future) for future in (newer, *others)] == [[42], [2], [4]]
        assert cloud.policy.batches == [[0], [21], [1], [2]]


def test_a_patient_batch_waits_for_more_until_it_is_full():
    with served(batch=2, patience_s=PATIENCE_S) as cloud:
        cloud.policy.gate.release(10)
        first = cloud.asked("first", 1)
        assert [outputs(cloud.ask("second", 2)), outputs(first)] == [[4], [2]]
        assert cloud.policy.batches == [[1, 2]]


def test_unlike_requests_are_not_put_together():
    with served() as cloud:
        cloud.busy()
        futures = [cloud.asked("a", 1), cloud.asked("b", [2, 3]), cloud.asked("c", 4)]
        cloud.policy.gate.release(3)
        assert [outputs(future) for future in futures] == [[2], [4, 6], [8]]
        assert cloud.policy.batches == [[0], [1, 4], [2]]


def test_faulty_request_does_not_fail_its_batch(caplog: pytest.LogCaptureFixture):
    with served() as cloud:
        cloud.busy()
        futures = [cloud.asked("a", 1), cloud.asked("b", 13), cloud.asked("c", 3)]
        cloud.policy.gate.release(10)
        assert [outputs(futures[0]), outputs(futures[2])] == [[2], [6]]
        assert failure(futures[1]) == "ValueError: thirteen"
        assert "ValueError: thirteen" in caplog.text


def test_number_that_is_not_finite_fails_only_its_request():
    with served() as cloud:
        assert failure(cloud.ask("a", np.nan)) == "the request: x[0] is nan, must be finite"
        cloud.busy()
        futures = [cloud.asked("b", 1), cloud.asked("c", 17)]
        cloud.policy.gate.release(10)
        assert outputs(futures[0]) == [2]
        assert failure(futures[1]) == "the policy's outputs: infer: twice[0] is inf, must be finite"


def test_expired_work_is_not_begun():
    with served() as cloud:
        first = cloud.busy()
        late = cloud.ask("late", 7, wait_ns=1_000_000)
        assert "within the deadline" in failure(late)
        cloud.policy.gate.release(10)
        outputs(first)
        assert outputs(cloud.ask("next", 1)) == [2]
        assert cloud.policy.batches == [[0], [1]]
        assert cloud.health()["robots"]["late"]["expired"] == 1


def test_a_full_queue_turns_away_what_comes():
    with served(queue=2, batch=1) as cloud:
        cloud.busy()
        waiting = [cloud.asked(f"robot {i}", i) for i in (1, 2)]
        assert failure(cloud.ask("robot 3", 3)) == "refused: the server is full: 2 requests waiting"
        newer = cloud.ask("robot 2", 4)
        assert "replaced by" in failure(waiting[1]), "it needs no further place"
        cloud.policy.gate.release(10)
        assert [outputs(future) for future in (waiting[0], newer)] == [[2], [8]]


def test_an_answer_says_how_long_it_waited_for_others_and_how_often_to_ask(monkeypatch: pytest.MonkeyPatch):
    now_ns = 0
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic_ns=lambda: now_ns))
    monkeypatch.setattr(Pacing, "pace_ns", lambda pacing, now_ns: 750_000_000)
    with served(batch=1, queue=1) as cloud:
        first = cloud.busy()
        second = cloud.asked("robot", 1)
        assert cloud.ask("other", 2).result(PATIENCE_S).pace_ns == 750_000_000, "when turned away, too"
        now_ns = 30_000_000
        cloud.policy.gate.release(1)
        assert (answer := first.result(PATIENCE_S)).queued_ns == 0
        assert (answer.latency_ms, answer.pace_ns) == (30.0, 750_000_000)
        assert cloud.policy.entered.acquire(timeout=PATIENCE_S)
        now_ns = 50_000_000
        cloud.policy.gate.release(1)
        assert (answer := second.result(PATIENCE_S)).queued_ns == 30_000_000
        assert (answer.latency_ms, answer.pace_ns) == (50.0, 750_000_000)


def test_the_service_measures_who_asks_and_what_it_costs(monkeypatch: pytest.MonkeyPatch):
    noted = []
    monkeypatch.setattr(Pacing, "ask", lambda pacing, robot, now_ns: noted.append(robot))
    monkeypatch.setattr(Pacing, "work", lambda pacing, size, took_ns: noted.append((size, took_ns > 0)))
    with served() as cloud:
        cloud.policy.gate.release(10)
        outputs(cloud.ask("robot", 1))
        cloud.ask("robot", 2, fingerprint="other").result(PATIENCE_S)
        assert noted == ["robot", (1, True)]


def test_garbage_is_counted_reported_and_harmless():
    with served() as cloud:
        cloud.policy.gate.release(10)
        answer = WireEncoder().encode(WireMessage(WireKind.ANSWER, 1))
        for payload, said in ((b"", "0 bytes"), (b"GET / HTTP/1.1" * 10, "not a frame"), (answer, "kind ANSWER")):
            assert said in failure(cloud.send(bytes(payload)))
        assert outputs(cloud.ask("robot", 3)) == [6]
        health = cloud.health()
        assert (health["malformed"], health["requests"], health["answered"]) == (3, 1, 1)
        assert set(health["robots"]) == {"robot"}


def test_another_policy_is_refused():
    with served() as cloud:
        text = failure(cloud.ask("robot", 1, fingerprint="other"))
        assert "'other'" in text
        assert cloud.policy.fingerprint() in text


def test_answers_say_whose_they_are_and_how_long_they_took():
    with served() as cloud:
        cloud.policy.gate.release()
        answer = cloud.ask("robot", 1, id=2**63, stamp_ns=77).result(PATIENCE_S)
        assert (answer.id, answer.stamp_ns, answer.robot) == (2**63, 77, "robot")
        assert answer.fingerprint == cloud.policy.fingerprint()
        assert answer.latency_ms > 0


def test_draining_finishes_what_is_there_and_refuses_what_comes():
    with served() as cloud:
        first = cloud.busy()
        waiting = cloud.asked("robot", 1)
        assert not cloud.service.drain(0.0)
        assert failure(cloud.ask("robot", 2)) == "refused: the server is stopping"
        assert cloud.health()["state"] == "draining"
        cloud.policy.gate.release(10)
        assert cloud.service.drain(PATIENCE_S)
        assert [outputs(first), outputs(waiting)] == [[0], [2]]


def test_a_policy_that_remembers_serves_one_robot_and_is_reset_for_each_episode(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_LEASE_NS", 100 * SOON_NS)
    with served(Net(stateful=True)) as cloud:
        cloud.policy.gate.release(10)
        for episode, seed in ((1, 7), (1, 7), (2, 8)):
            outputs(cloud.ask("first", 1, episode=episode, seed=seed))
        assert cloud.policy.seeds == [7, 8]
        assert "serves one robot at a time, at present 'first'" in failure(cloud.ask("second", 1))
        assert "reset failed: ValueError: a negative seed" in failure(cloud.ask("first", 1, episode=3, seed=-1))


class Choosy(Net):
    """Remembers; refuses what is 7, and fails at what is 13."""

    def __init__(self) -> None:
        super().__init__(stateful=True)
        self.gate.release(100)

    @override
    def check(self, tensors: Tensors) -> None:
        if (tensors["x"] == 7).any():
            raise PolicyError("seven is not for me")


@pytest.mark.parametrize(("x", "said"), [(7, "seven is not for me"), (13, "ValueError: thirteen")])
def test_a_request_that_a_policy_cannot_take_keeps_nobody_else_away(
    x: int, said: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(module, "_LEASE_NS", 100 * SOON_NS)
    with served(Choosy()) as cloud:
        assert failure(cloud.ask("stranger", x)) == said
        assert outputs(cloud.ask("robot", 1, seed=3)) == [2]
        assert (
            failure(cloud.ask("stranger", x))
            == "refused: this policy is stateful, so it serves one robot at a time, at present 'robot'"
        )
        assert cloud.policy.seeds[-1] == 3


def test_a_request_that_is_refused_does_not_make_a_policy_forget(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_LEASE_NS", 0)
    with served(Choosy()) as cloud:
        outputs(cloud.ask("robot", 1, episode=4, seed=3))
        assert failure(cloud.ask("stranger", 7, seed=9)) == "seven is not for me"
        outputs(cloud.ask("robot", 1, episode=4, seed=3))
        assert cloud.policy.seeds == [3]


def test_a_model_that_hangs_fails_all_requests_at_once_and_says_so(caplog: pytest.LogCaptureFixture):
    with served(hang_timeout_s=0.02) as cloud:
        stuck = cloud.busy()
        said = "refused: the model hangs: it has worked on one batch for more than 0.02 s"
        assert failure(stuck) == said
        assert cloud.hung.wait(PATIENCE_S)
        assert failure(cloud.ask("robot", 1)) == said
        assert cloud.health()["state"] == "hangs"
        assert caplog.messages == [said.removeprefix("refused: ")]


def test_requests_behind_a_hanging_model_fail():
    with served(hang_timeout_s=1.5) as cloud:
        stuck, waiting = cloud.busy(), cloud.asked("robot", 1)
        assert "the model hangs" in failure(waiting)
        assert "the model hangs" in failure(stuck)


def test_a_model_that_has_nothing_to_do_does_not_hang():
    with served(hang_timeout_s=0.02) as cloud:
        cloud.policy.gate.release(10)
        outputs(cloud.ask("robot", 1))
        assert not cloud.hung.wait(0.1)
        assert cloud.health()["state"] == "ready"


class Vouching(FakeTransport):
    """Knows every sender as `robot2`."""

    @override
    def serve(self, name: str, handler: Handler, *, workers: int = 16) -> Callable[[], None]:
        return super().serve(name, lambda payload, sender: handler(payload, "robot2"), workers=workers)


def test_sender_known_to_transport_counts_whatever_request_claims():
    cloud = Cloud(Net(), transport=Vouching())
    cloud.policy.gate.release()
    assert outputs(cloud.ask("robot1", 1)) == [2]
    assert list(cloud.health()["robots"]) == ["robot2"]
    cloud.close()


def test_a_name_is_served_once():
    with served() as cloud, pytest.raises(TransportError, match="served already"):
        InferenceService(Net(), cloud.transport, "net").start()


@contextmanager
def engine(cloud: Cloud, policy: Net | None = None) -> Iterator[RemoteEngine]:
    made = RemoteEngine(policy or cloud.policy, cloud.transport, "net", "so101", start_timeout_s=PATIENCE_S)
    try:
        yield made
    finally:
        made.close()


def serve_fake(transport: FakeTransport, answer: Handler) -> None:
    """A server of `Net` that answers as `answer` does."""
    offer = {"fingerprint": Net().fingerprint(), "weights": "", "spec": {}, "robots": 0, "canary": 0, "uptime_s": 9}
    transport.serve(offer_name("net", "fake"), lambda payload, sender: json.dumps(offer).encode())
    transport.serve(server_name("net", "fake"), answer)


def deadline(wait_s: float = PATIENCE_S) -> int:
    return time.monotonic_ns() + round(wait_s * 1e9)


def test_the_engine_gets_the_servers_outputs_and_its_latency():
    with served() as cloud, engine(cloud) as remote:
        remote.start()
        cloud.policy.gate.release(10)
        assert remote.infer({"x": np.arange(3.0)}, 1, deadline())["twice"].tolist() == [0, 2, 4]
        stats = remote.stats
        assert (stats.mode, stats.alive, stats.requests, stats.failures) == ("distributed", True, 1, 0)
        assert 0 < stats.model_ms <= stats.model_ms + stats.queue_ms <= stats.infer_ms
        (robot,) = cloud.health()["robots"]
        assert robot.startswith("so101-")


def test_the_engine_tells_both_sides_where_the_policies_differ():
    other = Net()
    other.spec = attrs.evolve(other.spec, chunk_size=99)
    with served() as cloud, engine(cloud, other) as remote:
        with pytest.raises(ContractError, match=r"chunk_size\n +robot: 99\n +server: 10") as caught:
            remote.start()
        assert "observations" not in str(caught.value)
        assert "equal specs" not in str(caught.value)
        with pytest.raises(PolicyError, match="is not the robot's model"):
            remote.infer({"x": np.zeros(1)}, 1, deadline())


def test_policies_that_differ_in_their_files_alone_are_reported(monkeypatch: pytest.MonkeyPatch):
    other = Net()
    monkeypatch.setattr(other, "fingerprint", lambda: "0ther")
    with (
        served() as cloud,
        engine(cloud, other) as remote,
        pytest.raises(ContractError, match=r"robot: 0ther\n +server: \w+\n +equal specs, but files or options"),
    ):
        remote.start()


def test_the_engine_says_that_nobody_serves_its_model():
    transport = FakeTransport()
    remote = RemoteEngine(Net(), transport, "net", "so101", start_timeout_s=0.0)
    with pytest.raises(PolicyError, match="no server for model 'net': nobody serves infer/net/health"):
        remote.start()
    with pytest.raises(PolicyError, match="nobody serves infer/net"):
        remote.infer({"x": np.zeros(1)}, 1, deadline())
    transport.serve(offer_name("net", "web"), lambda payload, sender: b"<html>")
    with pytest.raises(PolicyError, match="is not an ibrobot server: b'<html>'"):
        RemoteEngine(Net(), transport, "net", "so101", start_timeout_s=PATIENCE_S).start()
    transport.close()


def test_the_engine_goes_on_with_a_server_that_was_started_again():
    with served() as cloud, engine(cloud) as remote:
        cloud.policy.gate.release(10)
        remote.start()
        remote.reset(4)
        remote.infer({"x": np.zeros(1)}, 1, deadline())
        cloud.service.close()
        with pytest.raises(PolicyError, match="nobody serves"):
            remote.infer({"x": np.zeros(1)}, 2, deadline())
        cloud.until(lambda: not remote.stats.alive)
        again = Net(stateful=False)
        again.gate.release(10)
        service = InferenceService(again, cloud.transport, "net")
        service.start()
        try:
            cloud.until(lambda: remote.stats.alive)
            assert remote.infer({"x": np.ones(1)}, 3, deadline())["twice"].tolist() == [2]
            assert remote.stats.restarts == 1
        finally:
            service.close()


class Weighted(Net):
    """With weights of a given hash."""

    def __init__(self, weights: str) -> None:
        super().__init__()
        self._weights = weights

    @override
    def weights(self) -> str:
        return self._weights


def swap_weights(cloud: Cloud, weights: str) -> InferenceService:
    """A server with other weights in place of the one that was there."""
    cloud.service.close()
    again = Weighted(weights)
    again.gate.release(10)
    cloud.service = InferenceService(again, cloud.transport, "net")
    cloud.service.start()
    return cloud.service


def test_server_that_comes_back_with_other_weights_is_refused():
    with served(Weighted("a1")) as cloud, engine(cloud) as remote:
        cloud.policy.gate.release(10)
        remote.start()
        assert remote.stats.weights == cloud.health()["weights"] == "a1"
        remote.infer({"x": np.ones(1)}, 1, deadline())
        swap_weights(cloud, "b2")
        for number in (3, 4):
            with pytest.raises(
                PolicyError, match=r"restarted with different weights: hash b2, previously a1; start the"
            ):
                remote.infer({"x": np.ones(1)}, number, deadline())
        assert remote.stats.weights == "a1"
        swap_weights(cloud, "a1")
        assert remote.infer({"x": np.ones(1)}, 5, deadline())["twice"].tolist() == [2]


def test_other_weights_are_accepted_with_a_warning_where_the_user_says_so(caplog: pytest.LogCaptureFixture):
    with served(Weighted("a1")) as cloud:
        cloud.policy.gate.release(10)
        remote = RemoteEngine(Net(), cloud.transport, "net", "so101", accept_new_weights=True)
        remote.start()
        swap_weights(cloud, "b2")
        assert remote.infer({"x": np.ones(1)}, 2, deadline())["twice"].tolist() == [2]
        assert remote.stats.weights == "b2"
        assert (
            "restarted with different weights: hash b2, previously a1; the new weights are used from now on"
            in caplog.text
        )
        remote.close()


def test_server_that_comes_back_with_another_policy_is_refused_whatever_its_weights(monkeypatch: pytest.MonkeyPatch):
    with served(Weighted("a1")) as cloud:
        cloud.policy.gate.release(10)
        remote = RemoteEngine(Net(), cloud.transport, "net", "so101", accept_new_weights=True)
        remote.start()
        monkeypatch.setattr(Weighted, "fingerprint", lambda self: "0ther")
        swap_weights(cloud, "b2")
        with pytest.raises(PolicyError, match="is not the robot's model 'net'"):
            remote.infer({"x": np.ones(1)}, 2, deadline())
        remote.close()


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (b"nonsense", "8 bytes; a frame has"),
        (WireEncoder().encode(WireMessage(WireKind.ANSWER, 8)), "answered request 8"),
        (
            WireEncoder().encode(WireMessage(WireKind.FAILURE, 1, text="out of memory")),
            "the server of net: out of memory",
        ),
    ],
)
def test_the_engine_rejects_answers_to_other_requests(answer: bytes, said: str):
    transport = FakeTransport()
    serve_fake(transport, lambda payload, sender: answer)
    remote = RemoteEngine(Net(), transport, "net", "so101")
    with pytest.raises(PolicyError, match=said):
        remote.infer({"x": np.zeros(1)}, 1, deadline())
    assert remote.stats.failures == 1
    transport.close()


def test_the_engine_knows_waiting_from_work_and_the_pace():
    transport = FakeTransport()
    replies = [
        WireMessage(WireKind.ANSWER, 1, {}, fingerprint=Net().fingerprint(), latency_ms=50.0, queued_ns=30_000_000),
        WireMessage(WireKind.FAILURE, 2, text="full", pace_ns=750_000_000),
    ]
    serve_fake(transport, lambda payload, sender: WireEncoder().encode(replies[WireDecoder().decode(payload).id - 1]))
    remote = RemoteEngine(Net(), transport, "net", "so101")
    remote.infer({"x": np.zeros(1)}, 1, deadline())
    assert (remote.stats.model_ms, remote.stats.queue_ms, remote.stats.pace_ms) == (20.0, 30.0, 0.0)
    with pytest.raises(PolicyError, match="full"):
        remote.infer({"x": np.zeros(1)}, 2, deadline())
    assert remote.stats.pace_ms == 750.0
    transport.close()


def test_all_requests_on_their_way_in_an_outage_are_one_failure():
    transport = FakeTransport()
    together = threading.Barrier(5)

    def fail(payload: Any, sender: str | None) -> bytes:
        together.wait(PATIENCE_S)
        raise RuntimeError("the power is out")

    serve_fake(transport, fail)
    remote = RemoteEngine(Net(), transport, "net", "so101")
    with ThreadPoolExecutor(5) as pool:
        asked = [pool.submit(remote.infer, {"x": np.zeros(1)}, number, deadline()) for number in range(5)]
        assert all(isinstance(future.exception(PATIENCE_S), PolicyError) for future in asked)
    assert (remote.stats.requests, remote.stats.failures) == (5, 1)
    transport.kill(offer_name("net", "fake"), server_name("net", "fake"))
    with pytest.raises(PolicyError, match="nobody serves"):
        remote.infer({"x": np.zeros(1)}, 6, deadline())
    assert remote.stats.failures == 2, "one that was sent later"
    transport.close()


def test_the_engine_does_not_send_expired_requests():
    with served() as cloud, engine(cloud) as remote:
        with pytest.raises(PolicyError, match="expired before it was sent"):
            remote.infer({"x": np.zeros(1)}, 1, time.monotonic_ns())
        assert cloud.health()["requests"] == 0


def test_prometheus_learns_what_a_server_counts():
    with served() as cloud:
        cloud.policy.gate.release(10)
        for robot, x in (("one", 1), ("one", 2), ('t"wo\n', 13)):
            cloud.ask(robot, x).result(PATIENCE_S)
        asked = probes(cloud.service)
        families = {family.name: family for family in text_string_to_metric_families(asked.metrics().decode())}
        assert {"ibrobot_serve_waiting", "ibrobot_serve_pace_seconds", "ibrobot_serve_latency_p99_seconds"} < set(
            families
        )
        assert families["ibrobot_serve_requests"].samples[0].value == 3
        assert {sample.labels["robot"]: sample.value for sample in families["ibrobot_serve_robot_failed"].samples} == {
            "one": 0,
            't"wo\n': 1,
        }
        assert all(sample.labels["model"] == "net" for family in families.values() for sample in family.samples)
        assert (asked.unhealthy(), asked.unready()) == ("", "")
        cloud.service.drain(0.0)
        assert (asked.unhealthy(), asked.unready()) == ("", "the server is stopping")


def test_a_server_whose_model_hangs_is_unhealthy(caplog: pytest.LogCaptureFixture):
    with served(hang_timeout_s=0.02) as cloud:
        failure(cloud.busy())
        assert probes(cloud.service).unhealthy() == "the model hangs"
