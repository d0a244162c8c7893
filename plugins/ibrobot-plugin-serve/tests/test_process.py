"""The model in a process of its own: the same outputs, recovery after its death, nothing left behind."""

from __future__ import annotations

import os
import signal
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from ibrobot_serve.process import ProcessEngine
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.api import PolicyError, Tensors
from ibrobot_core.app import RobotConfig, load_config

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

PATIENCE_NS = 30_000_000_000
ROBOT = textwrap.dedent("""\
    robot:
      name: mini
      joints: [{name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}]
      groups: {arm: [pan]}
    simulation: {type: scene}
    executors: {arm_position: {type: position, group: arm}}
    models: {net: {type: net}, lost: {type: lost}}
    control_modes: {idle: {executors: [arm_position]}}
    default_control_mode: idle
    """)


@pytest.fixture
def config(site: Site, tmp_path: Path) -> RobotConfig:
    site.add("net-parts", Path(__file__).with_name("inference_parts.py"))
    (tmp_path / "mini.yaml").write_text(ROBOT)
    return load_config(tmp_path / "mini.yaml", sim=True)


def fingerprint(config: RobotConfig) -> str:
    return FakePolicy(host_context(robot=config.robot)).fingerprint()


@pytest.fixture
def engine(config: RobotConfig) -> Iterator[ProcessEngine]:
    engine = ProcessEngine(config, "net", fingerprint(config))
    engine.start()
    yield engine
    engine.close()
    engine.close()


@pytest.fixture
def ask(engine: ProcessEngine) -> Callable[..., Any]:
    count = 0

    def infer(do: str = "", patience_ns: int = PATIENCE_NS, **tensors: np.ndarray) -> Any:
        nonlocal count
        count += 1
        request = {"do": np.frombuffer(do.encode(), np.uint8)} if do else {}
        return engine.infer({"x": np.arange(3), **tensors, **request}, count, time.monotonic_ns() + patience_ns)

    return infer


def test_outputs_come_from_another_process_and_stay_as_they_are(engine: ProcessEngine, ask: Callable[..., Any]):
    outputs = ask(x=np.arange(6, dtype=np.float32).reshape(2, 3))
    ask(x=np.full((2, 3), 9, np.float32))
    np.testing.assert_array_equal(outputs["twice"], [[0, 2, 4], [6, 8, 10]])
    assert outputs["twice"].dtype == np.float32
    assert outputs["pid"] == engine.pid != os.getpid()
    assert engine.stats.alive
    assert (engine.stats.requests, engine.stats.failures, engine.stats.restarts) == (2, 0, 0)


def test_the_policy_is_reset_with_the_seed_of_the_episode(engine: ProcessEngine, ask: Callable[..., Any]):
    engine.reset(7)
    ask()
    engine.reset(8)
    engine.reset(9)
    assert ask()["seeds"].tolist() == ask()["seeds"].tolist() == [7, 9]


@pytest.mark.parametrize(("do", "said"), [("fail", "ValueError: not today"), ("object", "'o' has dtype object")])
def test_a_policy_that_raises_fails_its_request_only(do: str, said: str, ask: Callable[..., Any], caplog: Any):
    with pytest.raises(PolicyError, match=said):
        ask(do)
    assert ask()["twice"].tolist() == [0, 2, 4]


@pytest.mark.parametrize(("do", "how"), [("die", "killed by SIGKILL"), ("exit", "exit status 3")])
def test_a_process_that_dies_is_reported_and_starts_again(
    do: str, how: str, engine: ProcessEngine, ask: Callable[..., Any], caplog: pytest.LogCaptureFixture
):
    engine.reset(5)
    died = engine.pid
    with pytest.raises(PolicyError, match=f"process {died} died: {how}"):
        ask(do)
    assert not engine.stats.alive
    assert f"process {died} died: {how}; it restarts in 0 s" in caplog.text
    outputs = ask()
    assert outputs["pid"] == engine.pid != died
    assert outputs["seeds"].tolist() == [5], "it knows the episode"
    assert engine.stats.restarts == 1


def test_pauses_before_restarts_of_a_dying_process_grow(
    engine: ProcessEngine, ask: Callable[..., Any], caplog: pytest.LogCaptureFixture
):
    for pause_s in (0, 1, 2):
        with pytest.raises(PolicyError, match="killed by SIGKILL"):
            ask("die")
        assert f"it restarts in {pause_s} s" in caplog.text
        engine._start_again_s += 600 - pause_s  # so that the pause is not over yet, however slow this machine is
        with pytest.raises(PolicyError, match=r"restarts in [456]\d\d\.\d s"):
            ask()
        engine._start_again_s = 0.0


def test_process_killed_between_requests_is_detected(engine: ProcessEngine, ask: Callable[..., Any]):
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGKILL)
    with pytest.raises(PolicyError, match="killed by SIGKILL"):
        ask()
    assert ask()["twice"].tolist() == [0, 2, 4]


def test_late_answer_is_not_taken_for_the_next_request(engine: ProcessEngine, ask: Callable[..., Any]):
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGSTOP)
    for number in range(3):
        with pytest.raises(PolicyError, match=f"process {engine.pid} did not answer in time"):
            ask(patience_ns=1_000_000, x=np.array([number]))
    os.kill(engine.pid, signal.SIGCONT)
    assert ask(x=np.array([21]))["twice"].tolist() == [42]


def test_a_model_that_cannot_be_loaded_says_why(config: RobotConfig):
    engine = ProcessEngine(config, "lost", "")
    with pytest.raises(PolicyError, match="no such checkpoint: nowhere"):
        engine.start()
    engine.close()


def test_a_process_with_another_policy_than_the_host_is_refused(config: RobotConfig):
    engine = ProcessEngine(config, "net", "0123")
    with pytest.raises(PolicyError, match=rf"another policy, '{fingerprint(config)}', than the host, '0123'"):
        engine.start()
    assert engine.pid is None
    engine.close()


def test_a_process_that_hangs_is_replaced(
    engine: ProcessEngine, ask: Callable[..., Any], caplog: pytest.LogCaptureFixture
):
    engine.reset(5)
    engine._hang_timeout_s = 0.2
    hung = engine.pid
    said = [""]
    while "it hung" not in said[-1]:  # the first of them, or one that comes later
        with pytest.raises(PolicyError, match=r"did not answer in time|it hung") as caught:
            ask("hang", patience_ns=60_000_000)
        said.append(str(caught.value))
    assert said[-1] == f"the model's process {hung} died: it hung, working on one request for more than 0.2 s"
    assert len(said) > 2
    assert not engine.stats.alive
    assert "it hung, working on one request for more than 0.2 s; it restarts in 0 s" in caplog.text
    engine._hang_timeout_s = PATIENCE_NS / 1e9  # this machine may be busy
    outputs = ask()
    assert outputs["pid"] == engine.pid != hung
    assert outputs["seeds"].tolist() == [5]


def test_closing_ends_a_model_that_hangs(engine: ProcessEngine, ask: Callable[..., Any]):
    with pytest.raises(PolicyError, match="did not answer in time"):
        ask("hang", patience_ns=50_000_000)
    engine.close()
    with pytest.raises(PolicyError, match="was closed"):
        ask()


@pytest.mark.parametrize("accept", [False, True])
def test_process_that_starts_again_with_other_weights_is_accepted_only_where_the_user_says_so(
    config: RobotConfig, site: Site, caplog: pytest.LogCaptureFixture, accept: bool
):
    (site.folder / "weights").write_text("a1")
    engine = ProcessEngine(config, "net", fingerprint(config), accept_new_weights=accept)
    try:
        engine.start()
        assert engine.stats.weights == "a1"
        (site.folder / "weights").write_text("b2")
        die: Tensors = {"x": np.arange(3), "do": np.frombuffer(b"die", np.uint8)}
        with pytest.raises(PolicyError, match="died"):
            engine.infer(die, 1, time.monotonic_ns() + PATIENCE_NS)
        if accept:
            outputs = engine.infer({"x": np.arange(3)}, 2, time.monotonic_ns() + PATIENCE_NS)
            assert outputs["twice"].tolist() == [0, 2, 4]
            assert "the model's process restarted with different weights: hash b2, previously a1" in caplog.text
        else:
            with pytest.raises(PolicyError, match="the model's process restarted with different weights: hash b2"):
                engine.infer({"x": np.arange(3)}, 2, time.monotonic_ns() + PATIENCE_NS)
        assert engine.stats.weights == ("b2" if accept else "a1")
    finally:
        engine.close()
