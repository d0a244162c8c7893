"""The conformance suite of policies."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import attrs
import numpy as np
import pytest
from numpy.typing import NDArray

from ibrobot_core.api import Context, Frame, Policy, PolicyError, PolicySpec, Tensors
from ibrobot_testing.suite import Suite

_STEP_NS = 33_333_333


class PolicySuite(Suite[Policy]):
    """Checks of every `Policy`."""

    any_size: ClassVar[int] = 16
    """Replacement of -1 in the shapes of `frame`."""
    ignores: ClassVar[frozenset[str]] = frozenset()
    """Observations of the spec that do not affect the actions, e.g. the pictures of a policy without eyes."""

    def reference(self, ctx: Context) -> Iterator[tuple[Frame, NDArray[np.float64]]]:
        """Frames, and the chunks for them after `reset(0)` by another implementation, e.g. that of the training.

        Override it: colours in another order, degrees and reversed joints differ from it alone.
        """
        pytest.skip("override reference to have chunks compared with the original's")

    def another(self, ctx: Context) -> Policy:
        """A policy with other weights or statistics; override it to have `fingerprint` and `weights` checked."""
        pytest.skip("override another to have fingerprints checked")

    def frame(self, policy: Policy, ctx: Context, seed: int) -> Frame:
        """A frame with all inputs of the policy's spec; override it if random numbers are not suitable."""
        rng = np.random.default_rng(seed)
        now_ns = ctx.clock.now_ns()
        past = tuple(Frame(now_ns - i * _STEP_NS, self._values(policy, rng)) for i in range(policy.spec.history, 0, -1))
        prompt = "pick up the cube" if policy.spec.prompt else ""
        return Frame(now_ns, self._values(policy, rng), prompt=prompt, history=past)

    def _values(self, policy: Policy, rng: np.random.Generator) -> dict[str, NDArray[np.generic]]:
        values: dict[str, NDArray[np.generic]] = {}
        for key, shape in policy.spec.observations.items():
            sizes = tuple(self.any_size if n == -1 else n for n in shape)
            if len(sizes) == 3:  # an image
                values[key] = rng.integers(0, 256, sizes, dtype=np.uint8)
            else:
                values[key] = rng.uniform(-1, 1, sizes).astype(np.float32)
        return values

    @contextmanager
    def loaded(self) -> Iterator[tuple[Policy, Context]]:
        """A loaded policy with its context, at the beginning of an episode."""
        with self.in_use(lambda policy: policy.load(), lambda policy: policy.close()) as (policy, ctx):
            policy.reset(0)
            yield policy, ctx

    def _run(self, policy: Policy, ctx: Context, seed: int) -> list[NDArray[np.float64]]:
        policy.reset(seed)
        frames = [self.frame(policy, ctx, i) for i in range(3)]
        return [policy.postprocess(policy.infer(policy.preprocess(frame))).copy() for frame in frames]

    def test_spec_agrees_with_itself(self) -> None:
        """Sizes are positive, names as many as actions, and shapes made of positive numbers and -1."""
        with self.loaded() as (policy, _):
            spec = policy.spec
            assert spec.action_size > 0
            assert spec.chunk_size > 0
            if spec.actions is not None:
                assert len(spec.actions) == len(set(spec.actions)) == spec.action_size
            for key, shape in spec.observations.items():
                assert shape, f"{key} has no shape"
                assert all(n == -1 or n > 0 for n in shape), f"{key} has the shape {shape}"
            assert spec.rate_hz is None or spec.rate_hz > 0

    def test_chunks_are_as_specified(self) -> None:
        """A chunk is (N, A) float64 with 1 <= N <= chunk_size, all finite."""
        with self.loaded() as (policy, ctx):
            for chunk in self._run(policy, ctx, 1):
                _check_chunk(chunk, policy.spec)

    def test_chunks_have_the_length_of_the_spec(self) -> None:
        """Of several chunks, the longest has `chunk_size` actions: plans are made for this length."""
        with self.loaded() as (policy, ctx):
            longest = max(len(chunk) for chunk in self._run(policy, ctx, 1))
            assert longest == policy.spec.chunk_size, f"no chunk is longer than {longest}"

    def test_chunks_are_those_of_the_reference(self) -> None:
        """The chunks are those of another implementation, to 1e-4."""
        with self.loaded() as (policy, ctx):
            for frame, expected in self.reference(ctx):
                policy.reset(0)
                chunk = policy.postprocess(policy.infer(policy.preprocess(frame)))
                np.testing.assert_allclose(chunk, expected, rtol=1e-4, atol=1e-4)

    def test_each_observation_matters(self) -> None:
        """A change of any observation but those of `ignores` changes the chunk."""
        with self.loaded() as (policy, ctx):
            whole, other = self.frame(policy, ctx, 1), self.frame(policy, ctx, 2)
            policy.reset(0)
            chunk = policy.postprocess(policy.infer(policy.preprocess(whole))).copy()
            for key in policy.spec.observations.keys() - self.ignores:
                policy.reset(0)
                changed = attrs.evolve(whole, values={**whole.values, key: other.values[key]})
                moved = policy.postprocess(policy.infer(policy.preprocess(changed)))
                assert not np.array_equal(moved, chunk), f"{key} does not affect the actions; if so, name it in ignores"

    def test_other_policies_have_other_fingerprints(self) -> None:
        """Another policy differs in `fingerprint` or, once it is loaded, in `weights`."""
        with self.loaded() as (policy, ctx):
            other = self.another(ctx)
            try:
                other.load()
                mine = policy.fingerprint(), policy.weights()
                assert mine != (other.fingerprint(), other.weights()), "nothing tells the two policies apart"
            finally:
                other.close()

    def test_weights_come_with_load(self) -> None:
        """`weights` is empty before `load`: the constructor reads configuration and statistics only."""
        policy = self.make(self.context())
        try:
            assert policy.weights() == "", "the constructor has read the weights"
        finally:
            policy.close()

    def test_a_prefix_of_any_length_is_taken(self) -> None:
        """A policy with `prefix` returns valid chunks for prefixes of one action, several, and a whole chunk."""
        with self.loaded() as (policy, ctx):
            if not policy.spec.prefix:
                pytest.skip("takes no prefix")
            plan = self._run(policy, ctx, 1)[0]
            for length in sorted({1, (len(plan) + 1) // 2, len(plan)}):
                for delay in sorted({0, 1, length}):
                    frame = attrs.evolve(self.frame(policy, ctx, 1), prefix=plan[:length], delay_steps=delay)
                    _check_chunk(policy.postprocess(policy.infer(policy.preprocess(frame))), policy.spec)

    def test_a_missing_key_is_refused(self) -> None:
        """A frame that lacks a key of the spec is a PolicyError that names the key."""
        with self.loaded() as (policy, ctx):
            whole = self.frame(policy, ctx, 1)
            for key in policy.spec.observations:
                values = {k: v for k, v in whole.values.items() if k != key}
                with pytest.raises(PolicyError, match=key):
                    policy.preprocess(attrs.evolve(whole, values=values, missing=frozenset({key})))

    def test_an_observation_that_is_not_finite_is_refused(self) -> None:
        """NaN or infinity in any vector is a PolicyError that names the key."""
        with self.loaded() as (policy, ctx):
            whole = self.frame(policy, ctx, 1)
            for key in policy.spec.observations:
                if whole.values[key].dtype.kind == "f":
                    for value in (np.nan, np.inf):
                        spoiled = np.array(whole.values[key])
                        spoiled.flat[-1] = value
                        with pytest.raises(PolicyError, match=key):
                            policy.preprocess(attrs.evolve(whole, values={**whole.values, key: spoiled}))

    def test_a_history_of_any_length_is_taken(self) -> None:
        """A policy with `history` returns valid chunks at an episode's first tick and soon after."""
        with self.loaded() as (policy, ctx):
            if not policy.spec.history:
                pytest.skip("sees no history")
            frame = self.frame(policy, ctx, 1)
            for length in range(policy.spec.history):
                short = attrs.evolve(frame, history=frame.history[policy.spec.history - length :])
                _check_chunk(policy.postprocess(policy.infer(policy.preprocess(short))), policy.spec)

    def test_equal_seeds_act_alike(self) -> None:
        """After `reset` with the same seed, the same frames give identical results, whatever happened before."""
        with self.loaded() as (policy, ctx):
            first = self._run(policy, ctx, 3)
            self._run(policy, ctx, 4)
            for a, b in zip(first, self._run(policy, ctx, 3), strict=True):
                np.testing.assert_array_equal(a, b)

    def test_inputs_stay_as_they_were(self) -> None:
        """No step changes its input."""
        with self.loaded() as (policy, ctx):
            frame = self.frame(policy, ctx, 1)
            before = copy.deepcopy(frame.values)
            inputs = policy.preprocess(frame)
            assert _equal(frame.values, before), "preprocess changed the frame"
            before = copy.deepcopy(dict(inputs))
            outputs = policy.infer(inputs)
            assert _equal(inputs, before), "infer changed its input"
            before = copy.deepcopy(dict(outputs))
            policy.postprocess(outputs)
            assert _equal(outputs, before), "postprocess changed its input"

    def test_outputs_stay_as_they_were(self) -> None:
        """A chunk does not change when the next one is computed, nor with the frame and tensors that it was made of."""
        with self.loaded() as (policy, ctx):
            frame = self.frame(policy, ctx, 1)
            inputs = policy.preprocess(frame)
            outputs = policy.infer(inputs)
            chunk = policy.postprocess(outputs)
            for name, array in (*frame.values.items(), *inputs.items(), *outputs.items()):
                assert not np.shares_memory(chunk, array), f"the chunk is a view of {name}: return a copy"
            before = chunk.copy()
            policy.postprocess(policy.infer(policy.preprocess(self.frame(policy, ctx, 2))))
            np.testing.assert_array_equal(chunk, before)

    def test_outputs_of_each_step_stay_as_they_were(self) -> None:
        """What `preprocess` and `infer` returned does not change with the next request: requests overlap."""
        with self.loaded() as (policy, ctx):
            inputs = policy.preprocess(self.frame(policy, ctx, 1))
            inputs_before = copy.deepcopy(dict(inputs))
            outputs = policy.infer(inputs)
            outputs_before = copy.deepcopy(dict(outputs))
            policy.infer(policy.preprocess(self.frame(policy, ctx, 2)))
            assert _equal(inputs, inputs_before), "preprocess uses its output again"
            assert _equal(outputs, outputs_before), "infer uses its output again"

    def test_pre_and_postprocess_are_pure(self) -> None:
        """The same input gives the same output."""
        with self.loaded() as (policy, ctx):
            frame = self.frame(policy, ctx, 1)
            inputs = policy.preprocess(frame)
            assert _equal(inputs, policy.preprocess(frame))
            outputs = policy.infer(inputs)
            np.testing.assert_array_equal(policy.postprocess(outputs), policy.postprocess(outputs))

    def test_tensors_survive_the_wire(self) -> None:
        """Tensors are plain arrays, so that `infer` can run elsewhere with the same result."""
        with self.loaded() as (policy, ctx):
            frame = self.frame(policy, ctx, 1)
            policy.reset(5)
            here = policy.postprocess(policy.infer(policy.preprocess(frame))).copy()
            policy.reset(5)
            there = policy.postprocess(_wire(policy.infer(_wire(policy.preprocess(frame)))))
            np.testing.assert_array_equal(here, there)

    def test_a_batch_is_as_good_as_one_by_one(self) -> None:
        """`infer_batch` returns the outputs of `infer` in the order of the inputs, without shared memory."""
        with self.loaded() as (policy, ctx):
            if policy.spec.stateful:
                pytest.skip("each request changes what it remembers")
            batch = [policy.preprocess(self.frame(policy, ctx, i)) for i in range(3)]
            together = [copy.deepcopy(dict(outputs)) for outputs in policy.infer_batch(batch)]
            assert len(together) == len(batch)
            for inputs, outputs in zip(batch, together, strict=True):
                alone = policy.postprocess(policy.infer(inputs)).copy()
                np.testing.assert_allclose(policy.postprocess(outputs), alone, rtol=1e-4, atol=1e-5)

    def test_the_edge_needs_no_weights(self) -> None:
        """An unloaded policy can pre- and postprocess for another's `infer`, with the same fingerprint."""
        with self.loaded() as (policy, ctx):
            edge = self.make(ctx)
            try:
                edge.reset(0)
                assert edge.fingerprint() == policy.fingerprint()
                assert len(edge.fingerprint().encode()) <= 128
                frame = self.frame(policy, ctx, 1)
                policy.reset(0)
                here = policy.postprocess(policy.infer(policy.preprocess(frame))).copy()
                policy.reset(0)
                there = edge.postprocess(policy.infer(edge.preprocess(frame)))
                np.testing.assert_array_equal(here, there)
            finally:
                edge.close()

    def test_weights_have_one_hash(self) -> None:
        """`weights` is empty or a short text, and equal for equal weights."""
        with self.loaded() as (one, _), self.loaded() as (other, _):
            assert one.weights() == other.weights()
            assert len(one.weights().encode()) <= 128

    def test_its_identity_is_a_short_text(self) -> None:
        """`identity` is empty or a text of at most 1,024 bytes that recordings can hold."""
        with self.loaded() as (policy, _):
            assert len(policy.identity().encode()) <= 1024

    def test_infer_remembers_nothing(self) -> None:
        """The same input gives the same output, whatever happens in between, unless the spec is stateful."""
        with self.loaded() as (policy, ctx):
            if policy.spec.stateful:
                pytest.skip("says that it remembers")
            inputs = policy.preprocess(self.frame(policy, ctx, 1))
            first = copy.deepcopy(dict(policy.infer(inputs)))
            policy.infer(policy.preprocess(self.frame(policy, ctx, 2)))
            assert _equal(first, policy.infer(inputs))

    def test_close_is_safe_twice(self) -> None:
        """`close` may come before `load` and twice."""
        policy = self.make(self.context())
        policy.close()
        policy.load()
        policy.close()
        policy.close()


def _check_chunk(chunk: NDArray[np.float64], spec: PolicySpec) -> None:
    assert chunk.ndim == 2
    assert 1 <= chunk.shape[0] <= spec.chunk_size, f"a chunk of {chunk.shape[0]}"
    assert chunk.shape[1] == spec.action_size
    assert chunk.dtype == np.float64
    assert np.isfinite(chunk).all()


def _equal(a: Tensors, b: Tensors) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def _wire(tensors: Tensors) -> dict[str, NDArray[np.generic]]:
    """Dtype, shape and bytes are all that crosses."""
    received: dict[str, NDArray[np.generic]] = {}
    for key, value in tensors.items():
        assert isinstance(key, str)
        assert type(value) is np.ndarray, f"{key} is a {type(value).__name__}, not an array"
        assert value.dtype.kind in "biuf", f"{key} has dtype {value.dtype}"
        received[key] = np.frombuffer(value.tobytes(), value.dtype).reshape(value.shape)
    return received
