"""The conformance suite of engines."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import compress
from typing import ClassVar, override

import attrs
import numpy as np
import pytest

from ibrobot_core.api import Context, Engine, Frame, ModelContext, Policy, PolicyError, Tensors, ns
from ibrobot_core.app import RobotConfig
from ibrobot_testing.contexts import host_context
from ibrobot_testing.fakes import FakePolicy
from ibrobot_testing.suite import Suite


class EngineSuite(Suite[Engine]):
    """What every `Engine` must do. Its model is called `net`, and infers as `policy` does."""

    wait_s: ClassVar[float] = 30.0
    """How long an answer may take [s]."""

    def policy(self, ctx: Context) -> Policy:
        """A policy like the model's."""
        return FakePolicy(ctx)

    def tensors(self, policy: Policy, seed: int) -> Tensors:
        """Inputs for `infer`; override for a policy that sees more than vectors."""
        rng = np.random.default_rng(seed)
        shapes = policy.spec.observations.items()
        return policy.preprocess(Frame(0, {key: rng.uniform(-1, 1, shape).astype(np.float32) for key, shape in shapes}))

    @override
    def context(self) -> Context:
        """A context with a model; override for its YAML, or for its transport."""
        ctx = host_context("net")
        config = RobotConfig(robot=ctx.robot, executors={}, control_modes={}, default_control_mode="")
        return attrs.evolve(ctx, model=ModelContext(config, self.policy(ctx)))

    @contextmanager
    def started(self) -> Iterator[tuple[Engine, Policy]]:
        """A started engine, and a policy of its own that infers alike."""
        ctx = self.context()
        assert ctx.model is not None
        twin, engine = self.policy(ctx), self.make(ctx)
        try:
            twin.load()
            engine.start()
            yield engine, twin
        finally:
            engine.close()
            ctx.model.policy.close()
            twin.close()

    def _ask(self, engine: Engine, tensors: Tensors, request_id: int) -> Tensors:
        return engine.infer(tensors, request_id, time.monotonic_ns() + ns(self.wait_s))

    def test_start_makes_the_model_ready(self) -> None:
        """After `start` the statistics say that the model answers, which engine it is, and which weights act."""
        with self.started() as (engine, twin):
            assert engine.stats.alive
            assert engine.stats.mode
            assert engine.stats.weights == twin.weights()

    def test_outputs_are_those_of_the_policy(self) -> None:
        """Outputs have the names, dtypes, shapes and values that the policy gives here; inputs stay as they were."""
        with self.started() as (engine, twin):
            for seed in range(3):
                tensors = self.tensors(twin, seed)
                before = copy.deepcopy(tensors)
                _check_equal(self._ask(engine, tensors, seed + 1), twin.infer(tensors))
                _check_equal(tensors, before)

    def test_requests_are_counted(self) -> None:
        """The statistics have the number of requests, and how long the last one took."""
        with self.started() as (engine, twin):
            for seed in range(3):
                self._ask(engine, self.tensors(twin, seed), seed + 1)
            assert (engine.stats.requests, engine.stats.failures) == (3, 0)
            assert engine.stats.infer_ms > 0

    def test_a_failed_request_harms_no_other(self) -> None:
        """A request that the policy cannot take raises an error and counts as a failure; the next one is answered."""
        with self.started() as (engine, twin):
            with pytest.raises(Exception, match=r"\S"):
                self._ask(engine, {}, 1)
            assert (engine.stats.requests, engine.stats.failures) == (1, 1)
            tensors = self.tensors(twin, 1)
            _check_equal(self._ask(engine, tensors, 2), twin.infer(tensors))

    def test_a_new_episode_is_answered(self) -> None:
        """After `reset` requests are answered as before."""
        with self.started() as (engine, twin):
            tensors = self.tensors(twin, 1)
            self._ask(engine, tensors, 1)
            engine.reset(5)
            _check_equal(self._ask(engine, tensors, 2), twin.infer(tensors))

    def test_each_request_gets_its_own_answer(self) -> None:
        """`parallel` threads ask at a time. Each gets a PolicyError or its own outputs, which later answers keep."""
        with self.started() as (engine, twin):
            assert engine.parallel >= 1
            inputs = [self.tensors(twin, seed) for seed in range(3 * engine.parallel)]
            with ThreadPoolExecutor(engine.parallel) as pool:
                asked = [pool.submit(self._ask, engine, tensors, i) for i, tensors in enumerate(inputs, start=1)]
            answered = [each.exception() is None for each in asked]
            assert any(answered)
            for tensors, future in compress(zip(inputs, asked, strict=True), answered):
                _check_equal(future.result(), twin.infer(tensors))
            assert all(isinstance(each.exception(), PolicyError | None) for each in asked)

    def test_close_is_safe_at_any_time(self) -> None:
        """`close` may come before `start` and twice."""
        ctx = self.context()
        assert ctx.model is not None
        engine = self.make(ctx)
        engine.close()
        engine.close()
        ctx.model.policy.close()


def _check_equal(answer: Tensors, expected: Tensors) -> None:
    assert set(answer) == set(expected)
    for name, array in expected.items():
        assert answer[name].dtype == array.dtype, f"{name} is {answer[name].dtype}, not {array.dtype}"
        np.testing.assert_array_equal(answer[name], array, err_msg=name, strict=True)
