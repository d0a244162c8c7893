"""The policy suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_testing import PolicySuite, checks, failed_checks
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core.api import Frame, PolicyError


class SeeingPolicy(FakePolicy):
    """Sees one picture, whose red draws the joints on; it has weights."""

    gain = 0.0

    def __init__(self, ctx, trained=0.5):
        super().__init__(ctx)
        size = self.spec.action_size
        seen = {"observation.state": (size,), "observation.images.top": (4, 4, 3)}
        self.spec = attrs.evolve(self.spec, observations=seen)
        self._trained = trained

    def load(self):
        self.gain = self._trained

    def weights(self):
        return f"{self.gain}" if self.gain else ""

    def preprocess(self, frame):
        picture = frame.observation("observation.images.top", (4, 4, 3))
        return {**super().preprocess(frame), "red": picture[..., 0].mean(keepdims=True)}

    def infer(self, tensors):
        outputs = super().infer(tensors)
        return {**outputs, "delta": outputs["delta"] + self.gain * tensors["red"] / 255}


class TestPolicy(PolicySuite):
    @override
    def make(self, ctx):
        return SeeingPolicy(ctx)

    @override
    def another(self, ctx):
        kind = type(self.make(ctx))
        return (kind if issubclass(kind, SeeingPolicy) else SeeingPolicy)(ctx, trained=0.7)

    @override
    def reference(self, ctx):
        goal = np.random.default_rng(0).uniform(-0.5, 0.5, 6)
        shares = np.linspace(0.1, 1.0, 10)[:, None]
        for red in (0, 100, 255):
            state = np.linspace(-0.4, 0.6, 6, dtype=np.float32)
            picture = np.zeros((4, 4, 3), np.uint8)
            picture[..., 0] = red
            values: dict[str, Any] = {"observation.state": state, "observation.images.top": picture}
            yield Frame(ctx.clock.now_ns(), values), state + shares * (goal + 0.5 * red / 255 - state)


class BlindPolicy(SeeingPolicy):
    def preprocess(self, frame):
        return {**super().preprocess(frame), "red": np.zeros(1)}


class SeesBlueAsRed(SeeingPolicy):
    def preprocess(self, frame):
        picture = frame.observation("observation.images.top", (4, 4, 3))
        return {**super().preprocess(frame), "red": picture[..., 2].mean(keepdims=True)}


class ReversesJoints(SeeingPolicy):
    def postprocess(self, tensors):
        return super().postprocess(tensors)[:, ::-1].copy()


class ReversesTime(SeeingPolicy):
    def postprocess(self, tensors):
        return super().postprocess(tensors)[::-1].copy()


class ActsInDegrees(SeeingPolicy):
    def postprocess(self, tensors):
        return np.degrees(super().postprocess(tensors))


class ChunksOfOne(SeeingPolicy):
    def postprocess(self, tensors):
        return super().postprocess(tensors)[:1].copy()


class OneFingerprintForAll(SeeingPolicy):
    def weights(self):
        return "trained" if self.gain else ""


class LoadsInItsConstructor(SeeingPolicy):
    def __init__(self, ctx, trained=0.5):
        super().__init__(ctx, trained)
        self.load()


class MiscountsItsActions(FakePolicy):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, actions=(self.spec.actions or ())[1:])


class LongChunks(FakePolicy):
    def postprocess(self, tensors):
        return np.repeat(super().postprocess(tensors), 2, axis=0)


class SingleActions(FakePolicy):
    def postprocess(self, tensors):
        return super().postprocess(tensors)[0]


class SinglePrecision(FakePolicy):
    def postprocess(self, tensors):
        return super().postprocess(tensors).astype(np.float32)


class ZerosForMissing(FakePolicy):
    def preprocess(self, frame):
        state = np.zeros(6, np.float32)
        return super().preprocess(attrs.evolve(frame, values={"observation.state": state, **frame.values}))


class TakesNaN(FakePolicy):
    def preprocess(self, frame):
        state = np.nan_to_num(frame.values.get("observation.state", np.zeros(0)))
        return super().preprocess(attrs.evolve(frame, values={**frame.values, "observation.state": state}))


class RandomWithoutSeed(FakePolicy):
    def reset(self, seed):
        self._goal = np.random.default_rng().uniform(-0.5, 0.5, 6)


class RemembersTheLastEpisode(FakePolicy):
    episodes = 0

    def reset(self, seed):
        self.episodes += 1
        super().reset(self.episodes)


class ChangesTheFrame(FakePolicy):
    def preprocess(self, frame):
        tensors = super().preprocess(frame)
        frame.values["observation.state"][:] = 0.0
        return tensors


class NormalisesInPlace(FakePolicy):
    def infer(self, tensors):
        tensors["state"][:] /= 2.0
        return super().infer(tensors)


class ReusesItsChunk(FakePolicy):
    chunk = np.zeros((10, 6))

    def postprocess(self, tensors):
        self.chunk[:] = super().postprocess(tensors)
        return self.chunk


class ReturnsAView(FakePolicy):
    """Of the outputs, which the next `infer`, or what carries them between processes, may overwrite."""

    def infer(self, tensors):
        return {"plan": FakePolicy.postprocess(self, super().infer(tensors))}

    def postprocess(self, tensors):
        return tensors["plan"].view()


class ReturnsTheFrame(FakePolicy):
    """Stays where it is, by a view of the observation itself."""

    def __init__(self, ctx):
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, chunk_size=1)

    def preprocess(self, frame):
        return {"state": frame.observation("observation.state", (self.spec.action_size,))}

    def infer(self, tensors):
        return tensors

    def postprocess(self, tensors):
        return tensors["state"][None]


class CountsPreprocess(FakePolicy):
    count = 0

    def preprocess(self, frame):
        self.count += 1
        return {**super().preprocess(frame), "count": np.array([self.count])}


class SendsObjects(FakePolicy):
    def preprocess(self, frame):
        return {**super().preprocess(frame), "prompt": np.array([{"prompt": frame.prompt}], dtype=object)}


class ClosesOnce(FakePolicy):
    closed = False

    def close(self):
        if self.closed:
            raise PolicyError("closed already")
        self.closed = True


class TrustsThePrefixsLength(FakePolicy):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, prefix=True)

    def preprocess(self, frame):
        prefix = frame.prefix
        return {**super().preprocess(frame), **({} if prefix is None else {"pace": prefix[-1] - prefix[-2:][0]})}

    def postprocess(self, tensors):
        return super().postprocess(tensors) / tensors.get("pace", 1.0)

    def infer(self, tensors):
        return {**super().infer(tensors), **{key: tensors[key] for key in ("pace",) if key in tensors}}


class CountsRequests(FakePolicy):
    count = 0

    def infer(self, tensors):
        self.count += 1
        outputs = super().infer(tensors)
        return {**outputs, "delta": outputs["delta"] * self.count}


class WantsAWholeHistory(FakePolicy):
    def __init__(self, ctx):
        super().__init__(ctx)
        self.spec = attrs.evolve(self.spec, history=2)

    def postprocess(self, tensors):
        return super().postprocess(tensors)[:, : self.spec.action_size * self._seen]

    def preprocess(self, frame):
        self._seen = len(frame.history) == self.spec.history
        return super().preprocess(frame)


class ReversesBatches(FakePolicy):
    def infer_batch(self, batch):
        return super().infer_batch(batch)[::-1]


class AnswersABatchFromOneArray(FakePolicy):
    """Every robot of a batch gets the actions of the last one."""

    output = np.zeros(6)

    def infer(self, tensors):
        outputs = super().infer(tensors)
        self.output[:] = outputs["delta"]
        return {**outputs, "delta": self.output}

    def infer_batch(self, batch):
        return [self.infer(tensors) for tensors in batch]


class ReusesItsOutputs(AnswersABatchFromOneArray):
    def infer_batch(self, batch):
        return FakePolicy.infer_batch(self, batch)


class HashesTheObject(FakePolicy):
    def weights(self):
        return str(id(self))


class TellsItsStory(FakePolicy):
    def identity(self):
        return "trained with care, " * 100


class NeedsWeightsAtTheEdge(FakePolicy):
    scale: Any = None

    def load(self):
        self.scale = 1.0

    def preprocess(self, frame):
        return {key: np.multiply(value, self.scale) for key, value in super().preprocess(frame).items()}


WRONG = {
    BlindPolicy: "each_observation_matters",
    SeesBlueAsRed: "chunks_are_those_of_the_reference",
    ReversesJoints: "chunks_are_those_of_the_reference",
    ReversesTime: "chunks_are_those_of_the_reference",
    ActsInDegrees: "chunks_are_those_of_the_reference",
    ChunksOfOne: "chunks_have_the_length_of_the_spec",
    OneFingerprintForAll: "other_policies_have_other_fingerprints",
    LoadsInItsConstructor: "weights_come_with_load",
    HashesTheObject: "weights_have_one_hash",
    TellsItsStory: "its_identity_is_a_short_text",
    AnswersABatchFromOneArray: "a_batch_is_as_good_as_one_by_one",
    CountsRequests: "infer_remembers_nothing",
    ReversesBatches: "a_batch_is_as_good_as_one_by_one",
    NeedsWeightsAtTheEdge: "the_edge_needs_no_weights",
    MiscountsItsActions: "spec_agrees_with_itself",
    LongChunks: "chunks_are_as_specified",
    SingleActions: "chunks_are_as_specified",
    SinglePrecision: "chunks_are_as_specified",
    WantsAWholeHistory: "a_history_of_any_length_is_taken",
    TrustsThePrefixsLength: "a_prefix_of_any_length_is_taken",
    ZerosForMissing: "a_missing_key_is_refused",
    TakesNaN: "an_observation_that_is_not_finite_is_refused",
    RandomWithoutSeed: "equal_seeds_act_alike",
    RemembersTheLastEpisode: "equal_seeds_act_alike",
    ChangesTheFrame: "inputs_stay_as_they_were",
    NormalisesInPlace: "inputs_stay_as_they_were",
    ReusesItsChunk: "outputs_stay_as_they_were",
    ReturnsAView: "outputs_stay_as_they_were",
    ReturnsTheFrame: "outputs_stay_as_they_were",
    ReusesItsOutputs: "outputs_of_each_step_stay_as_they_were",
    CountsPreprocess: "pre_and_postprocess_are_pure",
    SendsObjects: "tensors_survive_the_wire",
    ClosesOnce: "close_is_safe_twice",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestPolicy):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


class ReusesItsInputs(FakePolicy):
    state = np.zeros(6)

    def preprocess(self, frame):
        inputs = super().preprocess(frame)
        self.state[:] = inputs["state"]
        return {**inputs, "state": self.state}


@pytest.mark.parametrize("wrong", [ReusesItsOutputs, ReusesItsInputs])
def test_only_one_check_catches_outputs_that_are_used_again(tmp_path, wrong):
    class Suite(TestPolicy):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert failed_checks(Suite, tmp_path) >= {"outputs_of_each_step_stay_as_they_were"}


def test_every_check_catches_something():
    assert checks(PolicySuite) == set(WRONG.values())
