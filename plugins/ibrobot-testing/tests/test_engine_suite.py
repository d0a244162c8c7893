"""The engine suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import override

import numpy as np
import pytest
from ibrobot_testing import EngineSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeEngine

from ibrobot_core.api import PolicyError


class TestFake(EngineSuite):
    @override
    def make(self, ctx):
        return FakeEngine(ctx)


class Parallel(FakeEngine):
    parallel = 4


class TestParallel(EngineSuite):
    @override
    def make(self, ctx):
        return Parallel(ctx)


class NeverReady(FakeEngine):
    def start(self):
        self.model.policy.load()


class SinglePrecision(FakeEngine):
    def run(self, tensors, request_id, deadline_ns):
        return {name: array.astype(np.float32) for name, array in super().run(tensors, request_id, deadline_ns).items()}


class CountsNothing(FakeEngine):
    def infer(self, tensors, request_id, deadline_ns):
        return self.run(tensors, request_id, deadline_ns)


class StaysDead(FakeEngine):
    dead = False

    def run(self, tensors, request_id, deadline_ns):
        if self.dead:
            raise PolicyError("the model died")
        self.dead = True
        outputs = super().run(tensors, request_id, deadline_ns)
        self.dead = False
        return outputs


class EndsWithItsEpisode(FakeEngine):
    def run(self, tensors, request_id, deadline_ns):
        if self._episode:
            raise PolicyError("this episode is over")
        return super().run(tensors, request_id, deadline_ns)


class AnswersFromOneArray(FakeEngine):
    parallel = 2
    output = np.zeros(6)

    def run(self, tensors, request_id, deadline_ns):
        outputs = super().run(tensors, request_id, deadline_ns)
        self.output[:] = outputs["delta"]
        return {**outputs, "delta": self.output}


class ClosesOnce(FakeEngine):
    closed = False

    def close(self):
        if self.closed:
            raise PolicyError("closed already")
        self.closed = True


WRONG = {
    NeverReady: "start_makes_the_model_ready",
    SinglePrecision: "outputs_are_those_of_the_policy",
    CountsNothing: "requests_are_counted",
    StaysDead: "a_failed_request_harms_no_other",
    EndsWithItsEpisode: "a_new_episode_is_answered",
    AnswersFromOneArray: "each_request_gets_its_own_answer",
    ClosesOnce: "close_is_safe_at_any_time",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestFake):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(EngineSuite) == set(WRONG.values())
