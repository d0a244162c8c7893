"""Policies that LeRobot trained act as they do in LeRobot alone, bit for bit on the CPU."""

from __future__ import annotations

import hashlib
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
import torch
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import SEED, LeRobotPolicy
from ibrobot_testing import PolicySuite
from ibrobot_testing.contexts import START_NS, host_context
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torch._subclasses.fake_tensor import FakeTensorMode

from ibrobot_core.api import Image, pixels
from ibrobot_core.bus import Bus
from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Frame, Policy

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CONFIGS, STATE, TOP, WRIST, Theirs, act, diffusion, normalised_by, save

pytestmark = pytest.mark.lerobot

STEP = 33_333_333


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("checkpoints")
    return {name: save(config(), root / name) for name, config in CONFIGS.items()}


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As many for LeRobot as for us, since sums depend on it."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def make(path: Path, **options: Any) -> LeRobotPolicy:
    return LeRobotPolicy(LeRobotPolicyOptions(path, threads=1, device="cpu", **options), host_context())


def loaded(path: Path, **options: Any) -> LeRobotPolicy:
    policy = make(path, **options)
    policy.load()
    policy.reset(3)
    return policy


def inputs(policy: LeRobotPolicy, frame: Frame) -> dict[str, NDArray[Any]]:
    """What the network sees."""
    found = policy._model.inputs([policy.preprocess(frame)])  # type: ignore[union-attr]
    return {name: tensor.numpy() for name, tensor in found.items()}


def run(policy: Policy, frame: Frame) -> tuple[NDArray[np.float64], int]:
    """The chunk, and the seed of its noise."""
    tensors = policy.preprocess(frame)
    return policy.postprocess(policy.infer(tensors)), int(tensors[SEED][0])


def frames(policy: Policy, count: int) -> list[Frame]:
    """Consecutive ticks, each with the history that a sampler gives it."""
    rng = np.random.default_rng(5)
    plain: list[Frame] = []
    for i in range(count):
        values = {
            key: rng.integers(0, 256, shape, np.uint8) if len(shape) == 3 else rng.uniform(-1, 1, shape)
            for key, shape in policy.spec.observations.items()
        }
        floats = {key: value if value.dtype == np.uint8 else value.astype(np.float32) for key, value in values.items()}
        plain.append(Frame(START_NS + i * STEP, floats))
    past = policy.spec.history
    return [attrs.evolve(frame, history=tuple(plain[max(0, i - past) : i])) for i, frame in enumerate(plain)]


def test_act_gives_lerobots_chunks(folders: dict[str, Path]) -> None:
    policy, theirs = loaded(folders["act"]), Theirs(folders["act"])
    for frame in frames(policy, 3):
        ours, seed = run(policy, frame)
        np.testing.assert_array_equal(ours, theirs.chunk(frame.values, seed).astype(np.float64))


@pytest.mark.parametrize("name", ["act", "diffusion", "vqbet"])
def test_actions_are_those_that_lerobot_selects(folders: dict[str, Path], name: str) -> None:
    """LeRobot sees every control step and predicts when its queue is empty; we are asked at those steps alone."""
    policy, theirs = loaded(folders[name]), Theirs(folders[name])
    length = policy.spec.chunk_size
    ticks = frames(policy, 2 * length + 1)
    chunk = np.empty((0, 0))
    for i, frame in enumerate(ticks):
        if i % length == 0:
            chunk, seed = run(policy, frame)
            assert len(chunk) == length
        selected = theirs.select(frame.values, seed)
        np.testing.assert_array_equal(chunk[i % length], selected.astype(np.float64), err_msg=f"{name} at step {i}")
    first, later = (run(policy, frame)[0] for frame in (ticks[0], ticks[-1]))
    assert np.abs(first - later).max() > 1e-4, "the network answers to what it sees"


@pytest.mark.parametrize("mode", ["IDENTITY", "MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10"])
def test_processors_in_numpy_are_lerobots(tmp_path: Path, mode: str) -> None:
    path = save(normalised_by(mode, act(dim_model=16)), tmp_path / "act")
    policy, theirs = loaded(path), Theirs(path)
    [frame] = frames(policy, 1)
    ours, wanted = inputs(policy, frame), theirs.batch(frame.values)
    for key in policy.spec.observations:
        np.testing.assert_array_equal(ours[key], wanted[key].numpy(), err_msg=key)
        assert ours[key].dtype == np.float32
    action = np.random.default_rng(1).normal(size=(1, 8, 6)).astype(np.float32)
    theirs_action = theirs.post(torch.from_numpy(action)).numpy()[0]
    np.testing.assert_array_equal(policy.postprocess({"action": action}), theirs_action.astype(np.float64))
    changed = mode == "IDENTITY" or not np.array_equal(ours[STATE][0], frame.values[STATE])
    assert changed, "the mode does something"


def test_a_renamed_camera_is_asked_for_by_the_robots_name(tmp_path: Path) -> None:
    path = save(act(), tmp_path / "act")
    file = path / "policy_preprocessor.json"
    file.write_text(file.read_text().replace('"rename_map": {}', f'"rename_map": {{"observation.images.x": "{TOP}"}}'))
    policy, theirs = loaded(path), Theirs(path)
    assert "observation.images.x" in policy.spec.observations
    assert TOP not in policy.spec.observations
    [frame] = frames(policy, 1)
    ours, wanted = inputs(policy, frame), theirs.batch(frame.values)
    for key in (TOP, WRIST):
        np.testing.assert_array_equal(ours[key], wanted[key].numpy())


def test_noise_depends_on_the_episodes_seed_and_the_tick(folders: dict[str, Path]) -> None:
    policy = loaded(folders["diffusion"])
    first, second = frames(policy, 2)
    one = run(policy, first)[0]
    np.testing.assert_array_equal(one, run(policy, first)[0])
    assert not np.array_equal(one, run(policy, attrs.evolve(first, stamp_ns=second.stamp_ns))[0])
    policy.reset(4)
    assert not np.array_equal(one, run(policy, first)[0])


def test_inference_leaves_the_processs_random_numbers_alone(folders: dict[str, Path]) -> None:
    policy = loaded(folders["diffusion"])
    tensors = policy.preprocess(frames(policy, 1)[0])
    torch.manual_seed(1)
    wanted = torch.rand(3)
    torch.manual_seed(1)
    policy.infer(tensors)
    assert torch.equal(torch.rand(3), wanted)


TOLERANCE = 1e-5
"""Of actions of a batch beside those of single runs: kernels for other sizes sum in another order."""


def network(policy: LeRobotPolicy) -> torch.nn.Module:
    """What a run of the policy calls once, or once for each step of denoising."""
    model = policy._model.network  # type: ignore[union-attr]
    return {"act": lambda: model.model, "diffusion": lambda: model.diffusion.unet, "vqbet": lambda: model.vqbet.policy}[
        model.config.type
    ]()


@pytest.mark.parametrize(("name", "runs"), [("act", 1), ("diffusion", 3), ("vqbet", 1)])
def test_a_batch_is_one_run(folders: dict[str, Path], name: str, runs: int) -> None:
    policy = loaded(folders[name])
    batch = [policy.preprocess(frame) for frame in frames(policy, 4)]
    calls: list[int] = []
    hook = network(policy).register_forward_hook(lambda *_: calls.append(1))
    together = [policy.postprocess(each) for each in policy.infer_batch(batch)]
    hook.remove()
    assert len(calls) == runs
    alone = [policy.postprocess(policy.infer(tensors)) for tensors in batch]
    assert np.abs(np.stack(together) - np.stack(alone)).max() < TOLERANCE
    assert len({chunk.tobytes() for chunk in together}) == 4, "each request has its own actions"
    backwards = [policy.postprocess(each) for each in policy.infer_batch(batch[::-1])][::-1]
    assert np.abs(np.stack(backwards) - np.stack(alone)).max() < TOLERANCE


@pytest.mark.parametrize("name", ["diffusion", "vqbet"])
def test_noise_of_a_batch_is_that_of_each_request_alone(folders: dict[str, Path], name: str) -> None:
    """Equal observations with equal seeds act alike, with other seeds not, whatever else is in the batch."""
    policy = loaded(folders[name])
    one = dict(policy.preprocess(frames(policy, 1)[0]))
    other = {**one, SEED: one[SEED] + 1}
    first, second, third = (np.asarray(each["action"], np.float64) for each in policy.infer_batch([one, other, one]))
    np.testing.assert_allclose(first, third, atol=TOLERANCE)
    assert np.abs(first - second).max() > 0.01


def test_a_batch_that_draws_in_unknown_ways_is_run_one_by_one(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    policy = loaded(folders["act"])
    model = policy._model.network  # type: ignore[union-attr]
    predict = model.predict_action_chunk
    monkeypatch.setattr(model, "predict_action_chunk", lambda inputs: predict(inputs) + torch.empty(1).log_normal_())
    batch = [policy.preprocess(frame) for frame in frames(policy, 3)]
    with caplog.at_level("INFO"):
        for _ in range(2):
            for tensors, outputs in zip(batch, policy.infer_batch(batch), strict=True):
                np.testing.assert_array_equal(outputs["action"], policy.infer(tensors)["action"])
    assert caplog.text.count("so requests run one by one") == 1


def test_inference_of_a_batch_leaves_the_processs_random_numbers_alone(folders: dict[str, Path]) -> None:
    policy = loaded(folders["diffusion"])
    batch = [policy.preprocess(frame) for frame in frames(policy, 3)]
    torch.manual_seed(1)
    wanted = torch.rand(3)
    torch.manual_seed(1)
    policy.infer_batch(batch)
    assert torch.equal(torch.rand(3), wanted)


def test_an_act_says_what_it_attends_to_and_acts_as_before(folders: dict[str, Path]) -> None:
    policy = loaded(folders["act"])
    batch = [policy.preprocess(frame) for frame in frames(policy, 3)]
    for tensors, together in zip(batch, policy.infer_batch(batch), strict=True):
        alone = policy.infer(tensors)
        looks = {name: weights for name, weights in alone.items() if name != "action"}
        assert {name: weights.shape for name, weights in looks.items()} == {
            f"attention.{TOP}": (3, 3), f"attention.{WRIST}": (3, 3)
        }  # fmt: skip
        assert 0.1 < sum(float(weights.sum()) for weights in looks.values()) < 1.0
        for name, weights in looks.items():
            np.testing.assert_allclose(floats(together[name]), floats(weights), atol=TOLERANCE)
        attention = policy._model._attention  # type: ignore[union-attr]
        attention.take = lambda: [{}]  # type: ignore[method-assign, union-attr]
        np.testing.assert_array_equal(policy.infer(tensors)["action"], alone["action"])
        del attention.take  # type: ignore[union-attr]
    assert set(loaded(folders["diffusion"]).infer(batch_of(folders["diffusion"]))) == {"action"}


def floats(tensor: NDArray[np.generic]) -> NDArray[np.float32]:
    return np.asarray(tensor, np.float32)


def batch_of(path: Path) -> dict[str, Any]:
    policy = make(path)
    return dict(policy.preprocess(frames(policy, 1)[0]))


@pytest.mark.parametrize("is_on", [True, False])
def test_what_an_act_attends_to_is_published_with_its_answer(folders: dict[str, Path], is_on: bool) -> None:
    policy = loaded(folders["act"], attention=is_on)
    context = policy._ctx
    bus = Bus(context.clock)
    policy._ctx = attrs.evolve(context, bus=bus)
    arrived = bus.subscribe("/attention/top")
    [frame] = frames(policy, 1)
    outputs = policy.infer(policy.preprocess(frame))
    assert arrived.drain() == [], "published by what runs beside the robot, wherever the network runs"
    policy.postprocess(outputs)
    if not is_on:
        assert bus.topics() == {}
        return
    [received] = arrived.drain()
    assert isinstance(received.message, Image)
    shown = pixels(received.message)[..., 0]
    weights = floats(outputs[f"attention.{TOP}"])
    assert shown.max() == 255
    np.testing.assert_allclose(shown.astype(np.float32), 255 * weights / weights.max(), atol=1.0)


def test_fewer_actions_on_demand(folders: dict[str, Path]) -> None:
    policy = loaded(folders["act"], n_action_steps=3)
    [frame] = frames(policy, 1)
    assert policy.spec.chunk_size == 3
    np.testing.assert_array_equal(run(policy, frame)[0], run(loaded(folders["act"]), frame)[0][:3])


def test_identity_states_what_computes_and_how(folders: dict[str, Path]) -> None:
    cpu = torch.backends.cpu.get_cpu_capability()
    identity = loaded(folders["act"]).identity()
    assert identity.endswith(f"torch {version('torch')}, cpu, {cpu}, threads 1")
    assert ", cpu in bfloat16, " in loaded(folders["act"], dtype="bfloat16").identity()


@pytest.mark.parametrize(("dtype", "is_rounded"), [("auto", True), ("bfloat16", True), ("float32", False)])
def test_gpu_repeats_itself_and_computes_float32_without_tf32(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, dtype: str, is_rounded: bool
) -> None:
    """Torch's settings, before it finds that there is no GPU."""
    cudnn = torch.backends.cudnn
    for setting, before in {"benchmark": True, "deterministic": False, "allow_tf32": True}.items():
        monkeypatch.setattr(cudnn, setting, before)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    policy = LeRobotPolicy(LeRobotPolicyOptions(folders["act"], device="cuda", dtype=dtype), host_context())
    with suppress(RuntimeError, AssertionError):
        policy.load()
    assert (cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32) == (False, True, is_rounded)


@pytest.mark.parametrize("name", ["act", "vqbet"])
def test_network_on_a_gpu_has_all_its_inputs_there(folders: dict[str, Path], name: str) -> None:
    """On torch's fake device, whose tensors have no values; an operation on two devices is an error."""
    policy = loaded(folders[name])
    batch = [policy.preprocess(frame) for frame in frames(policy, 2)]
    model = policy._model
    assert model is not None
    with FakeTensorMode(allow_non_fake_inputs=True), torch.no_grad():
        model._device = torch.device("cuda")
        model.network.to("cuda")
        model.steps = model.steps.of(lambda array: torch.as_tensor(array).to("cuda"))
        actions = model._run(model.inputs(batch), batch)
        assert actions.device.type == "cuda"
        assert actions.shape[::2] == (2, 6)


def test_half_precision_is_near(folders: dict[str, Path]) -> None:
    whole, half = loaded(folders["act"]), loaded(folders["act"], dtype="bfloat16")
    [frame] = frames(whole, 1)
    a, b = run(whole, frame)[0], run(half, frame)[0]
    assert 0 < np.abs(a - b).max() < 0.1


def test_a_first_run_that_overflows_is_refused(folders: dict[str, Path]) -> None:
    """The pictures hardly differ in the dataset, so that black ones are beyond float16."""
    said = r"act: infer of its first run \(torch.float16; bfloat16 and float32 have a larger range\): action.* is nan"
    with pytest.raises(PolicyError, match=said):
        loaded(folders["act"], dtype="float16")


def test_weights_that_are_not_finite_are_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(folders["act"], tmp_path / "act")
    weights = load_file(tmp_path / "act/model.safetensors")
    for value in (np.nan, np.inf):
        weights["model.action_head.bias"].fill_(value)
        save_file(weights, tmp_path / "act/model.safetensors")
        with pytest.raises(PolicyError, match=r"the weights model.action_head.bias have values that are not finite"):
            make(tmp_path / "act").load()


def test_a_first_run_that_fails_is_reported(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_lerobot.model.PolicyModel.predict", lambda self, batch: 1 / 0)
    with pytest.raises(PolicyError, match=r"act: its first run failed: ZeroDivisionError: division by zero"):
        make(folders["act"]).load()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({SEED: None}, "seed is missing, must be int64 (1,)"),
        ({STATE: np.zeros(6, np.float32)}, "observation.state is float32 (6,), must be float32 (1, 6)"),
        ({STATE: np.zeros((1, 6))}, "observation.state is float64 (1, 6), must be float32 (1, 6)"),
        ({TOP: np.zeros((480, 640, 3), np.uint8)}, f"{TOP} is uint8 (480, 640, 3), must be uint8 (96, 96, 3)"),
        ({"prefix": np.zeros((1, 2, 6), np.float32)}, "prefix is unknown"),
        ({SEED: None, "sed": np.zeros(1)}, "seed is missing, must be int64 (1,); sed is unknown"),
    ],
)
def test_a_request_that_another_client_got_wrong_is_reported(
    folders: dict[str, Path], changes: dict[str, Any], said: str
) -> None:
    policy = loaded(folders["act"])
    [frame] = frames(policy, 1)
    tensors = {**policy.preprocess(frame), **changes}
    with pytest.raises(PolicyError) as message:
        policy.infer({name: value for name, value in tensors.items() if value is not None})
    assert str(message.value) == f"the request's tensors: {said}"


def test_threads_are_set(folders: dict[str, Path]) -> None:
    policy = LeRobotPolicy(LeRobotPolicyOptions(folders["act"], threads=2, device="cpu"), host_context())
    policy.load()
    assert torch.get_num_threads() == 2


def test_weights_that_can_run_code_are_refused(tmp_path: Path) -> None:
    path = save(act(), tmp_path / "act")
    (path / "model.safetensors").rename(path / "pytorch_model.bin")
    with pytest.raises(PolicyError, match=r"weights in pytorch_model.bin, which can run any code"):
        make(path).load()
    (path / "pytorch_model.bin").unlink()
    with pytest.raises(PolicyError, match=r"has no weights: model.safetensors is missing"):
        make(path).load()


def test_weights_are_hashed(tmp_path: Path, folders: dict[str, Path]) -> None:
    path = folders["act"]
    policy = make(path)
    assert policy.weights() == ""
    policy.load()
    assert policy.weights() == hashlib.sha256((path / "model.safetensors").read_bytes()).hexdigest()[:32]
    other = shutil.copytree(path, tmp_path / "act")
    weights = load_file(other / "model.safetensors")
    save_file({name: tensor * 1.0001 for name, tensor in weights.items()}, other / "model.safetensors")
    trained_further = loaded(other)
    assert trained_further.fingerprint() == policy.fingerprint(), "the robot's side, without weights, still fits"
    assert trained_further.weights() != policy.weights()


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path = save(act(), tmp_path / "act")
    save(act(dim_model=16), tmp_path / "other")
    (tmp_path / "other/model.safetensors").replace(path / "model.safetensors")
    with pytest.raises(PolicyError, match="LeRobot cannot load it"):
        make(path).load()


class Conformance(PolicySuite):
    """The suite, of one checkpoint."""

    name: str

    @pytest.fixture(autouse=True)
    def _folders(self, folders: dict[str, Path]) -> None:
        self.folders = folders

    @override
    def make(self, ctx):
        return LeRobotPolicy(LeRobotPolicyOptions(self.folders[self.name], threads=1, device="cpu"), ctx)


class TestAct(Conformance):
    name = "act"


@pytest.mark.long  # of what it has beyond `act`, its noise, the tests above and below are about
class TestDiffusion(Conformance):
    name = "diffusion"
    ignores = frozenset({"observation.images.top", "observation.state"})  # untrained, it draws what is clipped anyway


@pytest.mark.long
class TestVqbet(Conformance):
    name = "vqbet"
    ignores = frozenset({"observation.images.top", "observation.state"})  # untrained, it takes the same codes for all


def test_a_single_observation_step_of_diffusion(tmp_path: Path) -> None:
    path = save(diffusion(n_obs_steps=1), tmp_path / "diffusion")
    policy, theirs = loaded(path), Theirs(path)
    [frame] = frames(policy, 1)
    chunk, seed = run(policy, frame)
    np.testing.assert_array_equal(chunk[0], theirs.select(frame.values, seed).astype(np.float64))
