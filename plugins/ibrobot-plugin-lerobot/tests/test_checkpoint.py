"""Checkpoints read without torch: what they need, what they were trained on, and how their numbers are processed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_lerobot.checkpoint import read_checkpoint
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_lerobot.policy_types import POLICY_TYPES
from ibrobot_testing.contexts import ARM, GRIPPER, START_NS, host_context
from safetensors.numpy import save_file

from ibrobot_core.api import (
    ActionPart,
    Contract,
    Feature,
    Float64MultiArray,
    Frame,
    JointState,
    ObservationPart,
    PolicyError,
)
from ibrobot_core.app import Align

STATE, TOP = "observation.state", "observation.images.top"
JOINTS = ARM + GRIPPER
FEATURES = {
    STATE: {"type": "STATE", "shape": [6]},
    TOP: {"type": "VISUAL", "shape": [3, 4, 5]},
    "action": {"type": "ACTION", "shape": [6]},
}
MODES = {"STATE": "MIN_MAX", "VISUAL": "MEAN_STD", "ACTION": "MEAN_STD"}
STATISTICS = {
    f"{STATE}.min": np.full(6, -1, np.float32),
    f"{STATE}.max": np.array([1, 1, 1, 1, 1, -1], np.float32),
    f"{TOP}.mean": np.array([0.5, 0.25, 0.0], np.float32).reshape(3, 1, 1),
    f"{TOP}.std": np.array([0.5, 0.25, 1.0], np.float32),
    "action.mean": np.arange(6, dtype=np.float32),
    "action.std": np.full(6, 2, np.float32),
}
CONTRACT = Contract(
    25.0,
    (
        ObservationPart(
            STATE,
            "/joint_states",
            JointState.ros_type,
            tuple(f"position.{joint}" for joint in JOINTS),
            None,
            Align(),
            Feature("float32", (6,)),
        ),
    ),
    (ActionPart("arm", "/commands", Float64MultiArray.ros_type, "hold", JOINTS),),
)


def step(name: str, **config: Any) -> dict[str, Any]:
    return {"registry_name": name, "config": config}


def write(path: Path, pre: tuple[dict[str, Any], ...] = (), **config: Any) -> Path:
    """A checkpoint without weights; `pre` goes before the standard steps."""
    path.mkdir(parents=True)
    features = {"input_features": {key: FEATURES[key] for key in (STATE, TOP)}, "output_features": {}}
    features["output_features"]["action"] = FEATURES["action"]
    given = {"type": "act", "n_obs_steps": 1, "chunk_size": 10, "n_action_steps": 10} | features | config
    (path / "config.json").write_text(json.dumps(given))
    normal = {"eps": 1e-8, "features": FEATURES, "norm_map": MODES}
    standard = (step("rename_observations_processor", rename_map={}), step("to_batch_processor"))
    device = step("device_processor", device="cuda", float_dtype=None)
    for name, kind, steps in (
        ("policy_preprocessor", "normalizer_processor", (*pre, *standard, device)),
        ("policy_postprocessor", "unnormalizer_processor", (device,)),
    ):
        entry = step(kind, **normal) | {"state_file": f"{name}.safetensors"}
        document = {"name": name, "steps": [*steps, entry]}
        (path / f"{name}.json").write_text(json.dumps(document))
        save_file(STATISTICS, path / f"{name}.safetensors")
    return path


def make(path: Path, **options: Any) -> LeRobotPolicy:
    return LeRobotPolicy(LeRobotPolicyOptions(path, **options), host_context())


def frame(value: float = 0.0, pixel: int = 0, **changes: Any) -> Frame:
    values: dict[str, Any] = {STATE: np.full(6, value, np.float32), TOP: np.full((4, 5, 3), pixel, np.uint8)}
    return attrs.evolve(Frame(START_NS, values), **changes)


def test_what_it_needs_and_gives(tmp_path: Path) -> None:
    spec = make(write(tmp_path / "act")).spec
    assert spec.observations == {STATE: (6,), TOP: (4, 5, 3)}
    assert (spec.actions, spec.action_size, spec.chunk_size, spec.rate_hz) == (None, 6, 10, None)
    assert (spec.prompt, spec.prefix, spec.history) == (False, False, 0)
    assert make(tmp_path / "act", n_action_steps=4).spec.chunk_size == 4
    spec = read_checkpoint(write(tmp_path / "diffusion", type="diffusion", n_obs_steps=2, horizon=16)).spec(None)
    assert (spec.history, spec.chunk_size) == (1, 10)
    spec = read_checkpoint(write(tmp_path / "pi0", type="pi0")).spec(None)
    assert (spec.prompt, spec.prefix) == (True, True)


def test_numbers_are_normalised_and_back(tmp_path: Path) -> None:
    policy = make(write(tmp_path / "act"))
    tensors: Any = policy.preprocess(frame(0.5, 51))
    np.testing.assert_allclose(tensors[STATE][0, :5], 0.5)
    assert tensors[STATE][0, 5] == pytest.approx(3e8), "a range of nothing is taken as 1e-8, as in LeRobot"
    assert (tensors[TOP].shape, tensors[TOP].dtype) == ((4, 5, 3), np.uint8), "pictures are the model's to normalise"
    actions = policy.postprocess({"action": np.ones((1, 10, 6), np.float32)})
    assert actions.dtype == np.float64
    np.testing.assert_allclose(actions, np.tile(2 + np.arange(6), (10, 1)))


def test_clients_in_other_languages_learn_of_every_tensor(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs/reference/wire.md").read_text(encoding="utf-8")
    policy = make(write(tmp_path / "pi0", type="pi0"))
    plan = np.zeros((3, 6))
    tensors: Any = policy.preprocess(frame(prompt="pick", prefix=plan, delay_steps=1))
    assert tensors.keys() == {STATE, TOP, "seed", "task", "prefix", "delay_steps"}
    for name in ("seed", "task", "prefix", "delay_steps"):
        dtype, shape = (cell.strip() for cell in page.partition(f"| `{name}` |")[2].split("|")[:2])
        assert (tensors[name].dtype, tensors[name].ndim) == (dtype, shape.count(",") + (shape != "(1,)"))


def test_history_begins_with_the_oldest_available_frame(tmp_path: Path) -> None:
    policy = make(write(tmp_path / "diffusion", type="diffusion", n_obs_steps=3, horizon=16))
    past = (frame(0.1), frame(0.2), frame(0.3))

    def seen(one: Frame) -> list[float]:
        state = policy.preprocess(one)[STATE]
        assert state.shape == (1, 3, 6)
        return [round(float(value), 5) for value in state[0, :, 0]]

    assert seen(frame(0.4)) == [0.4, 0.4, 0.4]
    assert seen(frame(0.4, history=past[2:])) == [0.3, 0.3, 0.4]
    assert seen(frame(0.4, history=past[1:])) == [0.2, 0.3, 0.4]
    assert seen(frame(0.4, history=past)) == [0.2, 0.3, 0.4]


def test_a_prompt_and_the_plan_travel_with_the_observation(tmp_path: Path) -> None:
    policy = make(write(tmp_path / "pi0", type="pi0"))
    with pytest.raises(PolicyError, match="pi0 needs a prompt"):
        policy.preprocess(frame())
    plain = policy.preprocess(frame(prompt="piştir"))
    assert plain["task"].tobytes().decode() == "piştir"
    assert "prefix" not in plain
    assert "delay_steps" not in plain
    prefix = np.arange(18.0).reshape(3, 6)
    tensors: Any = policy.preprocess(frame(prompt="x", prefix=prefix, delay_steps=2))
    np.testing.assert_allclose(tensors["prefix"], (prefix[None] - np.arange(6)) / 2)
    assert tensors["delay_steps"].tolist() == [2]
    assert "prefix" not in make(write(tmp_path / "act")).preprocess(frame(prefix=prefix))


def test_a_seed_for_each_tick_of_each_episode(tmp_path: Path) -> None:
    policy = make(write(tmp_path / "act"))
    seeds = set()
    for episode in (0, 1, -1):
        policy.reset(episode)
        for stamp_ns in (0, 1):
            [seed] = policy.preprocess(frame(stamp_ns=stamp_ns))["seed"]
            assert seed >= 0
            seeds.add(int(seed))
    assert len(seeds) == 6


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({TOP: None}, "needs observation.images.top, which the frame at"),
        ({STATE: np.zeros(7, np.float32)}, r"needs observation.state of shape \(6,\), got \(7,\)"),
        ({TOP: np.zeros((4, 5, 3), np.uint16)}, "with 8-bit pixels, got uint16"),
    ],
)
def test_frames_that_do_not_fit(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    policy = make(write(tmp_path / "act"))
    changed = {key: value for key, value in {**frame().values, **values}.items() if value is not None}
    with pytest.raises(PolicyError, match=message):
        policy.preprocess(frame(values=changed))


def test_what_it_was_trained_on(tmp_path: Path) -> None:
    note = {"contract": CONTRACT.canonical(), "conversion": {"norm_mode": "degrees"}}
    beside = write(tmp_path / "beside")
    (beside / "ibrobot.json").write_text(json.dumps(note))
    by_dataset = write(tmp_path / "by_dataset")
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/meta/ibrobot.json").write_text(json.dumps(note))
    (by_dataset / "train_config.json").write_text(json.dumps({"dataset": {"root": str(tmp_path / "set")}}))
    for path in (beside, by_dataset):
        spec = make(path).spec
        assert (spec.actions, spec.rate_hz, spec.norm_mode) == (JOINTS, 25.0, "degrees")
        assert spec.contract == CONTRACT.canonical()
    (tmp_path / "set/meta/ibrobot.json").unlink()
    assert make(by_dataset).spec.actions is None
    (beside / "ibrobot.json").write_text('{"contract": {}}')
    with pytest.raises(PolicyError, match=r"beside/ibrobot.json: is not a meta/ibrobot.json file of `ibrobot convert`"):
        make(beside)


def test_both_sides_of_a_network_agree_by_the_fingerprint(tmp_path: Path) -> None:
    one, same = make(write(tmp_path / "one")), make(write(tmp_path / "same"))
    assert one.fingerprint() == same.fingerprint()
    statistics = {**STATISTICS, "action.std": np.full(6, 3, np.float32)}
    save_file(statistics, tmp_path / "same/policy_postprocessor.safetensors")
    assert one.fingerprint() != make(tmp_path / "same").fingerprint()


def _empty(path: Path) -> None:
    (path / "config.json").rename(path / "x.json")


def _inner(path: Path) -> None:
    _empty(path)
    (path / "checkpoints/last/pretrained_model").mkdir(parents=True)


def _old(path: Path) -> None:
    (path / "policy_preprocessor.json").unlink()


def _cut(path: Path) -> None:
    (path / "config.json").write_text('{"type": ')


def _no_features(path: Path) -> None:
    (path / "config.json").write_text('{"type": "act"}')


def _adapter(path: Path) -> None:
    (path / "config.json").write_text('{"use_peft": true}')


def _no_statistics(path: Path) -> None:
    (path / "policy_preprocessor.safetensors").unlink()


def _too_few(path: Path) -> None:
    save_file({f"{STATE}.min": np.zeros(6, np.float32)}, path / "policy_preprocessor.safetensors")


def _garbage(path: Path) -> None:
    (path / "policy_preprocessor.safetensors").write_bytes(b"\xff" * 64)


def _relative(path: Path) -> None:
    file = path / "policy_postprocessor.json"
    document = json.loads(file.read_text())
    document["steps"].append(step("absolute_actions_processor", enabled=True))
    file.write_text(json.dumps(document))


def _statistics_of_another_robot(path: Path) -> None:
    save_file({**STATISTICS, "action.mean": np.zeros(7, np.float32)}, path / "policy_postprocessor.safetensors")


def test_weights_larger_than_the_memory_are_not_read(tmp_path: Path) -> None:
    path = write(tmp_path / "act")
    with (path / "model.safetensors").open("wb") as file:
        file.truncate(1 << 43)
    with pytest.raises(PolicyError, match=r"model.safetensors: has 8796 GB, more than this machine's memory"):
        make(path).check_weights()


@pytest.mark.parametrize(("size", "fits"), [(6, True), (7, False)])
def test_weights_are_compared_with_the_configuration_without_torch(tmp_path: Path, size: int, fits: bool) -> None:
    policy = make(write(tmp_path / "act"))
    with pytest.raises(PolicyError, match=r"has no weights: model.safetensors is missing"):
        policy.check_weights()
    save_file({"model.action_head.weight": np.zeros((size, 2), np.float32)}, tmp_path / "act/model.safetensors")
    if fits:
        policy.check_weights()
    else:
        with pytest.raises(PolicyError, match=r"safetensors: actions have 7 values, but config.json says 6"):
            policy.check_weights()


def rewrite(path: Path, file: str, statistics: dict[str, Any]) -> None:
    save_file(statistics, path / f"policy_{file}.safetensors")


def renamed(statistics: dict[str, Any], key: str) -> dict[str, Any]:
    """Statistics of one feature under the key of a data set, as in a public base model."""
    return {f"so100.buffer.{name}" if name.startswith(f"{key}.") else name: value for name, value in statistics.items()}


@pytest.mark.parametrize(
    ("file", "key"),
    [("preprocessor", STATE), ("preprocessor", TOP), ("preprocessor", "action"), ("postprocessor", "action")],
)
def test_statistics_that_do_not_cover_a_feature_are_refused_with_the_keys_of_both_sides(
    tmp_path: Path, file: str, key: str
) -> None:
    path = write(tmp_path / "act")
    without = {name: value for name, value in STATISTICS.items() if not name.startswith(f"{key}.")}
    for statistics in (renamed(STATISTICS, key), without):
        rewrite(path, file, statistics)
        with pytest.raises(PolicyError) as found:
            make(path)
        assert f"policy_{file}.safetensors: has no statistics of {key}, which M" in str(found.value)
        assert f"the policy's features: {STATE}, {TOP}, action" in str(found.value)
        if statistics is not without:
            assert f"so100.buffer.{key}" in str(found.value)


@pytest.mark.parametrize("file", ["preprocessor", "postprocessor"])
def test_processor_without_its_normalisation_is_refused(tmp_path: Path, file: str) -> None:
    path = write(tmp_path / "act", normalization_mapping=MODES)
    make(path)
    document = json.loads((path / f"policy_{file}.json").read_text())
    document["steps"].pop()
    (path / f"policy_{file}.json").write_text(json.dumps(document))
    with pytest.raises(
        PolicyError, match=r"no step normalises action, but normalization_mapping in config.json says AC"
    ):
        make(path)


def test_action_is_unnormalised_if_the_step_does_not_list_it(tmp_path: Path) -> None:
    """As in LeRobot, whose step takes every action."""
    path = write(tmp_path / "act")
    file = path / "policy_postprocessor.json"
    document = json.loads(file.read_text())
    del document["steps"][-1]["config"]["features"]["action"]
    file.write_text(json.dumps(document))
    actions = make(path).postprocess({"action": np.ones((1, 10, 6), np.float32)})
    np.testing.assert_allclose(actions, np.tile(2 + np.arange(6), (10, 1)))


def test_elements_that_never_changed_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make(write(tmp_path / "act"))
    assert f"{STATE}: elements 5 never changed in the training data" in caplog.text


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_no_checkpoint_passes_normalised_numbers_on(whole: Path, data: st.DataObject) -> None:
    """300 statistics and steps: keys renamed or lost, sizes, NaN, infinity, swapped ends, no width, or nothing."""
    file, key = data.draw(st.sampled_from((("pre", STATE), ("pre", TOP), ("pre", "action"), ("post", "action"))))
    mode = data.draw(st.sampled_from(("MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10")))
    kinds = dict.fromkeys(MODES, "MEAN_STD") | {FEATURES[key]["type"]: mode}
    names = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99")}.get(
        mode, ("q10", "q90")
    )
    size = 3 if key == TOP else 6
    good = {f"{each}.{name}": np.ones(3 if each == TOP else 6) for each in FEATURES for name in ("mean", "std")}
    good |= {f"{key}.{names[0]}": np.zeros(size), f"{key}.{names[1]}": np.ones(size)}
    statistics = {name: value.astype(np.float32) for name, value in good.items()}
    first, second = (f"{key}.{name}" for name in names)
    spoil = data.draw(st.sampled_from(("none", "key", "lost", "size", "number", "swapped", "flat")))
    which, element = data.draw(st.sampled_from((first, second))), data.draw(st.integers(0, size - 1))
    if spoil == "key":
        prefix = data.draw(st.sampled_from(("so100.buffer.", "x", "observation.", "normalize_inputs.buffer_")))
        statistics = {f"{prefix}{name}" if name.startswith(key) else name: value for name, value in statistics.items()}
    elif spoil == "lost":
        del statistics[which]
    elif spoil == "size":
        statistics[which] = np.ones(data.draw(st.sampled_from((1, 2, 5, 7))), np.float32)
    elif spoil == "number":
        statistics[which][element] = data.draw(st.sampled_from((np.nan, np.inf, -np.inf)))
    elif spoil == "swapped":
        statistics[second][element] = -1.0
    elif spoil == "flat":
        statistics[second] = np.zeros_like(statistics[first])
    document = json.loads((whole / f"policy_{file}processor.json").read_text())
    document["steps"][-1]["config"]["norm_map"] = kinds
    (whole / f"policy_{file}processor.json").write_text(json.dumps(document))
    rewrite(whole, f"{file}processor", statistics)
    try:
        policy = make(whole)
    except PolicyError:
        assert spoil != "none"
        return
    finally:
        for each in ("pre", "post"):
            rewrite(whole, f"{each}processor", good_statistics())
            _with_modes(whole / f"policy_{each}processor.json")
    assert spoil == "none"
    assert key in (policy._pre if file == "pre" else policy._post).normalising[0].modes


def good_statistics() -> dict[str, Any]:
    return {
        f"{each}.{name}": np.ones(3 if each == TOP else 6, np.float32) for each in FEATURES for name in ("mean", "std")
    }


def _with_modes(path: Path) -> None:
    document = json.loads(path.read_text())
    document["steps"][-1]["config"]["norm_map"] = dict.fromkeys(MODES, "MEAN_STD")
    path.write_text(json.dumps(document))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write(tmp_path_factory.mktemp("checkpoints") / "act")
    for each in ("pre", "post"):
        rewrite(path, f"{each}processor", good_statistics())
        _with_modes(path / f"policy_{each}processor.json")
    return path


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_empty, "is not a folder with a checkpoint: it has no config.json; lerobot-train writes it to"),
        (_inner, "did you mean .*/checkpoints/last/pretrained_model"),
        (_old, "has no policy_preprocessor.json: it is from before LeRobot 0.4"),
        (_cut, "config.json: cannot be read"),
        (_no_features, "config.json: is not a policy configuration of LeRobot 0.6: KeyError"),
        (_adapter, "contains only an adapter"),
        (_no_statistics, "policy_preprocessor.safetensors: cannot be read"),
        (_too_few, "MIN_MAX needs observation.state.max, which is missing"),
        (_statistics_of_another_robot, r"action.mean has shape \(7,\), its feature \(6,\)"),
        (_garbage, "policy_preprocessor.safetensors: cannot be read"),
        (_relative, "actions relative to the state"),
    ],
)
def test_folders_without_a_checkpoint(tmp_path: Path, spoil: Any, message: str) -> None:
    path = write(tmp_path / "act")
    spoil(path)
    with pytest.raises(PolicyError, match=message):
        make(path)


def _without_chunk(path: Path) -> None:
    file = path / "config.json"
    config = json.loads(file.read_text())
    for name in ("chunk_size", "n_action_steps"):
        config.pop(name, None)
    file.write_text(json.dumps({**config, "type": "other", "frame_chunk_size": 4}))


@pytest.mark.parametrize("kind", ["groot", "pi0_fast", "wall_x"])
def test_policy_that_runs_downloaded_code_is_refused_before_it_asks_for_allowances(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / kind, type=kind, text_tokenizer_name="google/any", pretrained_name_or_path="x/y")
    with pytest.raises(PolicyError) as found:
        make(path)
    assert str(found.value) == (
        f"{path}/config.json: policies of type '{kind}' are not supported: {POLICY_TYPES[kind].why}"
    )


def test_policy_without_the_length_of_its_chunks_is_refused_in_one_sentence(tmp_path: Path) -> None:
    path = write(tmp_path / "other")
    _without_chunk(path)
    with pytest.raises(PolicyError) as found:
        make(path)
    assert str(found.value) == (
        f"{path}/config.json: policies of type 'other' are not supported: none of chunk_size, action_chunk_size, "
        "action_horizon, n_action_steps gives the length of their action chunks"
    )


def test_all_allowances_are_asked_for_at_once(tmp_path: Path) -> None:
    tokenizer = step("tokenizer_processor", tokenizer_name="me/words")
    path = write(tmp_path / "vla", (tokenizer,), type="smolvla", vlm_model_name="me/vlm")
    with pytest.raises(PolicyError, match=r"with the model's base_models: \[me/vlm, me/words\]$"):
        make(path)


def test_the_robots_side_needs_neither_torch_nor_weights(tmp_path: Path) -> None:
    path = write(tmp_path / "act")
    code = f"""
import sys
sys.modules["torch"] = sys.modules["lerobot"] = None
sys.path.insert(0, {str(Path(__file__).parent)!r})
import numpy as np
from pathlib import Path
from test_checkpoint import frame, make
policy = make(Path({str(path)!r}))
policy.preprocess(frame())
policy.postprocess({{"action": np.zeros((1, 10, 6), np.float32)}})
try:
    policy.infer(policy.preprocess(frame()))
except Exception as error:
    print(error)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == f"{path} is not loaded: call load() first"


def test_without_lerobot_it_is_said_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "act")
    save_file(STATISTICS, path / "model.safetensors")
    odd = write(tmp_path / "odd", (step("tokenizer_processor"),), type="smolvla")
    for name in ("ibrobot_lerobot.model", "ibrobot_lerobot.pipeline"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(PolicyError, match=r"need LeRobot .* pip install lerobot"):
        make(path).load()
    with pytest.raises(PolicyError, match=r"need LeRobot .* pip install lerobot"):
        make(odd)
