"""The policy `onnx` on small graphs that the tests make."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar, override

import numpy as np
import onnx
import pytest
from ibrobot_onnx import ibrobot_policies
from ibrobot_onnx.options import MANIFEST, OnnxPolicyOptions
from ibrobot_onnx.policy import OnnxPolicy
from ibrobot_testing import PolicySuite, check_descriptor, host_context
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from ibrobot_core.api import Context, Frame, Policy, PolicyError

SIZE, CHUNK, HORIZON = 6, 4, 6
STATE, CAMERA = "observation.state", "observation.images.top"
IMAGE = (8, 10, 3)


def _value(name: str, *shape: Any, dtype: int = TensorProto.FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, dtype, ["batch", *shape])


def save(path: Path, nodes: list[onnx.NodeProto], inputs: list[Any], output: Any, **constants: Any) -> None:
    """A graph with an output."""
    initializers = [numpy_helper.from_array(np.array(value), name) for name, value in constants.items()]
    graph = helper.make_graph(nodes, path.stem, inputs, [output], initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def policy_graph(path: Path, *, history: int = 0, noise: bool = False) -> None:
    """Every action is the newest state plus the mean of the image, and the noise if there is any."""
    ticks = (history + 1,) if history else ()
    inputs = [_value(STATE, *ticks, SIZE), _value(CAMERA, *ticks, *IMAGE, dtype=TensorProto.UINT8)]
    axes = list(range(1, 4 + len(ticks)))
    nodes = [
        helper.make_node("Cast", [CAMERA], ["pixels"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["pixels", "axes"], ["mean"], keepdims=0),
        helper.make_node("Unsqueeze", ["mean", "ones"], ["column"]),
        helper.make_node("Gather", [STATE, "last"], ["newest"], axis=1)
        if history
        else helper.make_node("Identity", [STATE], ["newest"]),
        helper.make_node("Add", ["newest", "column"], ["one"]),
        helper.make_node("Unsqueeze", ["one", "ones"], ["row"]),
        helper.make_node("Add", ["row", "zeros"], ["rows"]),
    ]
    if noise:
        inputs.append(_value("noise", CHUNK, SIZE))
        nodes.append(helper.make_node("Add", ["rows", "noise"], ["action"]))
    else:
        nodes.append(helper.make_node("Identity", ["rows"], ["action"]))
    zeros = np.zeros((1, CHUNK, SIZE), np.float32)
    last = np.array(history, np.int64)
    ones, mean = np.array([1], np.int64), np.array(axes, np.int64)
    save(path, nodes, inputs, _value("action", CHUNK, SIZE), zeros=zeros, ones=ones, axes=mean, last=last)


def denoising_graphs(folder: Path) -> None:
    """The network's output is a tenth of the sample plus the state, at any time."""
    inputs = [_value(STATE, SIZE), _value(CAMERA, *IMAGE, dtype=TensorProto.UINT8)]
    save(
        folder / "condition.onnx",
        [helper.make_node("Identity", [STATE], ["condition"])],
        inputs,
        _value("condition", SIZE),
    )
    nodes = [
        helper.make_node("Unsqueeze", ["condition", "ones"], ["row"]),
        helper.make_node("Mul", ["sample", "tenth"], ["small"]),
        helper.make_node("Add", ["small", "row"], ["output"]),
    ]
    step = [_value("sample", HORIZON, SIZE), _value("time", dtype=TensorProto.INT64), _value("condition", SIZE)]
    tenth = np.array(0.1, np.float32)
    save(folder / "denoise.onnx", nodes, step, _value("output", HORIZON, SIZE), ones=np.array([1]), tenth=tenth)


MANIFEST_OF_ONE: dict[str, Any] = {
    "format": 1,
    "type": "act",
    "observations": {STATE: [SIZE], CAMERA: list(IMAGE)},
    "history": 0,
    "action_size": SIZE,
    "chunk_size": CHUNK,
    "first": 0,
    "scale": [2.0] * SIZE,
    "offset": [0.5] * SIZE,
    "graphs": ["policy.onnx"],
    "noise": None,
    "clip": None,
    "denoising_steps": [],
    "trained_on": {},
    "source": {},
}
NOISE = {"distribution": "normal", "shape": [CHUNK, SIZE]}
DENOISING: dict[str, Any] = {
    "graphs": ["condition.onnx", "denoise.onnx"],
    "noise": {"distribution": "normal", "shape": [HORIZON, SIZE]},
    "first": 1,
    "clip": 1.0,
    "denoising_steps": [[10, 0.9, -0.5, 0.4, 0.3, 0.2, 0.1], [0, 1.1, 0.2, 0.6, 0.1, 0.0, 0.0]],
}


def exported(folder: Path, **changes: Any) -> Path:
    """An exported policy."""
    folder.mkdir(exist_ok=True)
    manifest = MANIFEST_OF_ONE | changes
    (folder / MANIFEST).write_text(json.dumps(manifest))
    if len(manifest["graphs"]) == 1:
        policy_graph(folder / "policy.onnx", history=manifest["history"], noise=manifest["noise"] is not None)
    else:
        denoising_graphs(folder)
    return folder


def make(folder: Path, **options: Any) -> OnnxPolicy:
    return OnnxPolicy(OnnxPolicyOptions(folder, threads=1, **options), host_context())


def loaded(folder: Path, **options: Any) -> OnnxPolicy:
    policy = make(folder, **options)
    policy.load()
    return policy


def frame(stamp_ns: int = 5, level: int = 40) -> Frame:
    state = np.linspace(-1, 1, SIZE, dtype=np.float32)
    return Frame(stamp_ns, {STATE: state, CAMERA: np.full(IMAGE, level, np.uint8)})


def chunk(policy: Policy, seen: Frame) -> np.ndarray[Any, Any]:
    return policy.postprocess(policy.infer(policy.preprocess(seen)))


class _Suite(PolicySuite):
    changes: ClassVar[dict[str, Any]]

    @pytest.fixture(autouse=True)
    def folder(self, tmp_path: Path) -> None:
        self.path = exported(tmp_path / "exported", **self.changes)

    @override
    def make(self, ctx: Context) -> Policy:
        return OnnxPolicy(OnnxPolicyOptions(self.path, threads=1), ctx)


class TestOneGraph(_Suite):
    changes: ClassVar[dict[str, Any]] = {}


class TestHistory(_Suite):
    changes: ClassVar[dict[str, Any]] = {"history": 2}


class TestNoise(_Suite):
    changes: ClassVar[dict[str, Any]] = {"noise": NOISE}


class TestDenoising(_Suite):
    changes: ClassVar[dict[str, Any]] = DENOISING
    ignores = frozenset({"observation.images.top"})  # its graph is made of the noise and the state


def test_descriptor_is_right(tmp_path: Path) -> None:
    [descriptor] = ibrobot_policies()
    check_descriptor(descriptor, OnnxPolicyOptions(exported(tmp_path / "exported")))
    assert descriptor.reads(tmp_path / "exported")
    assert not descriptor.reads(tmp_path)


def test_actions_are_unnormalised(tmp_path: Path) -> None:
    seen = frame()
    actions = chunk(loaded(exported(tmp_path / "exported")), seen)
    expected = np.tile(2.0 * (np.asarray(seen.values[STATE], np.float64) + 40.0) + 0.5, (CHUNK, 1))
    np.testing.assert_allclose(actions, expected, atol=1e-5)


def test_a_short_history_is_filled_with_its_first_frame(tmp_path: Path) -> None:
    policy = make(exported(tmp_path / "exported", history=2))
    tensors = policy.preprocess(Frame(9, frame(level=3).values, history=(frame(level=1),)))
    assert tensors[CAMERA][:, 0, 0, 0].tolist() == [1, 1, 3]


def test_denoising_is_the_linear_steps_of_the_manifest(tmp_path: Path) -> None:
    policy, seen = loaded(exported(tmp_path / "exported", **DENOISING)), frame()
    policy.reset(7)
    random = np.random.default_rng(np.array([7, seen.stamp_ns], np.uint64))
    x = random.standard_normal((HORIZON, SIZE), np.float32)
    for _, estimate_x, estimate_y, next_e, next_x, next_y, next_z in DENOISING["denoising_steps"]:
        y = x * np.float32(0.1) + np.asarray(seen.values[STATE], np.float32)
        estimate = np.clip(estimate_x * x + estimate_y * y, -1, 1)
        x = next_e * estimate + next_x * x + next_y * y
        if next_z:
            x = x + next_z * random.standard_normal((HORIZON, SIZE), np.float32)
    expected = 2.0 * x[1 : 1 + CHUNK] + 0.5
    np.testing.assert_allclose(chunk(policy, seen), expected, atol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("changes", [{}, {"history": 2}, {"noise": NOISE}])
def test_graph_with_weights_that_are_not_finite_does_not_load(tmp_path: Path, value: float, changes: Any) -> None:
    folder = exported(tmp_path / "exported", **changes)
    graph = onnx.load(folder / "policy.onnx")
    for each in graph.graph.initializer:
        if each.name == "zeros":
            weights = np.array(numpy_helper.to_array(each))
            weights.flat[0] = value
            each.CopyFrom(numpy_helper.from_array(weights, "zeros"))
    onnx.save(graph, str(folder / "policy.onnx"))
    said = r"exported: infer of its first run: action\[0, 0\] is -?(nan|inf), must be finite"
    with pytest.raises(PolicyError, match=said):
        loaded(folder)


def test_a_graph_that_returns_text_is_refused(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported")
    inputs = [_value(STATE, SIZE), _value(CAMERA, *IMAGE, dtype=TensorProto.UINT8)]
    rows = np.full((1, CHUNK, SIZE), "0.5").astype(object)
    save(
        folder / "policy.onnx",
        [helper.make_node("Identity", ["rows"], ["action"])],
        inputs,
        _value("action", CHUNK, SIZE, dtype=TensorProto.STRING),
        rows=rows,
    )
    with pytest.raises(PolicyError, match="the graph returns text; actions are numbers"):
        loaded(folder)


def looping_graph(path: Path, *, always: bool) -> None:
    """Its loop does not end: always, or if the first joint is above 0."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes"]), helper.make_node("Identity", ["before"], ["after"])],
        "body",
        [
            helper.make_tensor_value_info("turn", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("before", TensorProto.FLOAT, ["batch", CHUNK, SIZE]),
        ],
        [
            helper.make_tensor_value_info("goes", TensorProto.BOOL, []),
            helper.make_tensor_value_info("after", TensorProto.FLOAT, ["batch", CHUNK, SIZE]),
        ],
    )
    nodes = [
        helper.make_node("Unsqueeze", [STATE, "ones"], ["row"]),
        helper.make_node("Add", ["row", "zeros"], ["rows"]),
        helper.make_node("ReduceMax", [STATE], ["largest"], keepdims=0),
        helper.make_node("Greater", ["largest", "none"], ["above"]),
        helper.make_node("Or", ["above", "begin"], ["begins"]),
        helper.make_node("Loop", ["turns", "begins", "rows"], ["action"], body=body),
    ]
    inputs = [_value(STATE, SIZE), _value(CAMERA, *IMAGE, dtype=TensorProto.UINT8)]
    constants = {"turns": np.array(2**62), "begin": np.array(always), "ones": np.array([1])}
    zeros = np.zeros((1, CHUNK, SIZE), np.float32)
    none = np.array(0, np.float32)
    save(path, nodes, inputs, _value("action", CHUNK, SIZE), zeros=zeros, none=none, **constants)


def test_a_graph_that_does_not_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_onnx.policy._FIRST_S", 0.05)
    folder = exported(tmp_path / "exported")
    looping_graph(folder / "policy.onnx", always=True)
    with pytest.raises(PolicyError, match=r"its first run takes more than 0\.05 s"):
        loaded(folder)


@pytest.mark.parametrize("requests", [1, 2, 3])
def test_a_request_that_does_not_end_fails_and_the_next_one_is_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, requests: int
) -> None:
    monkeypatch.setattr("ibrobot_onnx.policy._LATER_S", 0.05)
    folder = exported(tmp_path / "exported")
    looping_graph(folder / "policy.onnx", always=False)
    policy = loaded(folder)
    state = np.linspace(-0.6, -0.1, SIZE, dtype=np.float32)
    good: dict[str, NDArray[Any]] = {STATE: state, CAMERA: np.zeros(IMAGE, np.uint8)}
    bad = {**good, STATE: -state}
    with pytest.raises(PolicyError, match=rf"exported: a request takes more than {0.05 * requests:g} s; such a graph"):
        policy.infer_batch([*[good] * (requests - 1), bad])
    np.testing.assert_array_equal(policy.infer(good)["action"], [state] * CHUNK)


def test_a_graph_larger_than_the_memory_is_not_read(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported")
    os.truncate(folder / "policy.onnx", 1 << 43)
    with pytest.raises(PolicyError, match=r"policy.onnx: has 8796 GB, more than this machine's memory"):
        loaded(folder)


def test_scale_that_overflows_does_not_load(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported", scale=[1.7e308] * SIZE, offset=[1.7e308] * SIZE, noise=NOISE)
    with pytest.raises(PolicyError, match="postprocess of its first run"):
        loaded(folder)


def test_noise_depends_on_the_seed_and_the_tick(tmp_path: Path) -> None:
    policy = loaded(exported(tmp_path / "exported", noise=NOISE))
    policy.reset(1)
    first = chunk(policy, frame(1))
    assert not np.array_equal(first, chunk(policy, frame(2)))
    policy.reset(2)
    assert not np.array_equal(first, chunk(policy, frame(1)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format is 2, must 1; export the checkpoint again"),
        ({"observations": {}}, "observations is {}"),
        ({"observations": {STATE: [0]}}, r"observations.observation.state is \[0\]"),
        ({"observations": {STATE: [1 << 20, 1 << 20]}}, "at most"),
        ({"action_size": True}, "action_size is True"),
        ({"chunk_size": 0}, "chunk_size is 0"),
        ({"history": -1}, "history is -1"),
        ({"scale": [1.0]}, "scale is"),
        ({"offset": [float("nan")] * SIZE}, "offset is"),
        ({"graphs": ["../policy.onnx"]}, "graphs is"),
        ({"graphs": ["policy.onnx", "other.onnx"]}, "one file"),
        ({"noise": {"distribution": "cauchy", "shape": [1]}}, "noise is"),
        ({"clip": -1.0}, "clip is -1.0"),
        ({"denoising_steps": [[1, 2]], "noise": DENOISING["noise"]}, r"denoising_steps\[0\]"),
        ({"denoising_steps": DENOISING["denoising_steps"]}, "noise is None"),
        ({"trained_on": {"contract": 3}}, "trained_on"),
    ],
    ids=lambda each: "-".join(each) if isinstance(each, dict) else "",
)
def test_a_wrong_value_of_the_manifest_is_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    folder = exported(tmp_path / "exported")
    (folder / MANIFEST).write_text(json.dumps(MANIFEST_OF_ONE | change))
    with pytest.raises(PolicyError, match=f"{MANIFEST}: .*{message}"):
        make(folder)


@pytest.mark.parametrize("content", ["", "[1]", "{", "[" * 100_000])
def test_a_damaged_manifest_is_an_error(tmp_path: Path, content: str) -> None:
    (tmp_path / MANIFEST).write_text(content)
    with pytest.raises(PolicyError, match=MANIFEST):
        make(tmp_path)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"it has no onnx_policy\.json; `ibrobot export"):
        make(tmp_path)


def test_damaged_graphs_are_refused(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported")
    graph, random = (folder / "policy.onnx").read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        damaged = bytearray(graph)
        for place in random.integers(0, len(graph), random.integers(1, 8)):
            damaged[place] = random.integers(256)
        (folder / "policy.onnx").write_bytes(bytes(damaged[: random.integers(1, len(graph) + 1)]))
        policy = make(folder)
        try:
            policy.load()
        except PolicyError:
            with pytest.raises(PolicyError, match="is not loaded"):
                chunk(policy, frame())


def test_a_graph_reads_no_other_file(tmp_path: Path) -> None:
    """ONNX may keep weights in files that the graph names; here they would be any file of the machine."""
    folder = exported(tmp_path / "exported")
    (tmp_path / "secret").write_bytes(np.ones((1, CHUNK, SIZE), np.float32).tobytes())
    model = onnx.load(str(folder / "policy.onnx"))
    for place in ("../secret", str(tmp_path / "secret")):
        [zeros] = [each for each in model.graph.initializer if each.name == "zeros"]
        zeros.ClearField("raw_data")
        zeros.ClearField("external_data")
        zeros.data_location = TensorProto.EXTERNAL
        zeros.external_data.add(key="location", value=place)
        (folder / "policy.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(PolicyError, match=r"policy\.onnx: ONNX Runtime cannot load it"):
            loaded(folder)


def test_a_graph_that_returns_another_size_is_refused(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported")
    (folder / MANIFEST).write_text(json.dumps(MANIFEST_OF_ONE | {"chunk_size": CHUNK + 1}))
    with pytest.raises(PolicyError, match=r"returns actions of shape \(4, 6\); .* at least 5 actions"):
        loaded(folder)


def test_a_missing_graph_is_needed_only_for_inference(tmp_path: Path) -> None:
    folder = exported(tmp_path / "exported")
    (folder / "policy.onnx").unlink()
    policy = make(folder)
    policy.preprocess(frame())
    with pytest.raises(PolicyError, match=r"policy\.onnx: is missing"):
        policy.check_weights()


def test_a_provider_that_is_not_installed_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match=r"'tensorrt': the installed ONNX Runtime .* has only .*cpu.*onnx"):
        loaded(exported(tmp_path / "exported"), provider="tensorrt")


def test_requests_of_another_kind_are_refused(tmp_path: Path) -> None:
    policy = loaded(exported(tmp_path / "exported"))
    tensors = dict(policy.preprocess(frame()))
    wrong = {
        "is missing": {STATE: tensors[STATE]},
        "is float64": {**tensors, STATE: tensors[STATE].astype(np.float64)},
        r"is uint8 \(3,\)": {**tensors, CAMERA: np.zeros(3, np.uint8)},
        "x is unknown": {**tensors, "x": np.zeros(1)},
    }
    for message, request in wrong.items():
        with pytest.raises(PolicyError, match=message):
            policy.infer(request)


def test_weights_change_the_hash_and_the_manifest_the_fingerprint(tmp_path: Path) -> None:
    one, other = loaded(exported(tmp_path / "one")), make(exported(tmp_path / "other", scale=[3.0] * SIZE))
    assert one.fingerprint() == make(tmp_path / "one").fingerprint() != other.fingerprint()
    assert (
        one.weights() == loaded(tmp_path / "one").weights() != loaded(exported(tmp_path / "d", **DENOISING)).weights()
    )


def test_fewer_actions_may_be_used(tmp_path: Path) -> None:
    policy = loaded(exported(tmp_path / "exported"), n_action_steps=2)
    assert policy.spec.chunk_size == 2
    assert chunk(policy, frame()).shape == (2, SIZE)


def test_nothing_is_sent_to_the_makers_of_onnx_runtime(tmp_path: Path) -> None:
    """Their telemetry keeps a database in the user's cache."""
    folder = exported(tmp_path / "exported")
    code = (
        "import os, pathlib; from ibrobot_onnx.options import OnnxPolicyOptions\n"
        "from ibrobot_onnx.policy import OnnxPolicy; from ibrobot_testing.contexts import host_context\n"
        f"OnnxPolicy(OnnxPolicyOptions(pathlib.Path({str(folder)!r})), host_context()).load()"
    )
    environment = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    environment |= {"HOME": str(tmp_path / "home"), "XDG_CACHE_HOME": str(tmp_path / "home/.cache")}
    (tmp_path / "home").mkdir()
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    assert not [each for each in (tmp_path / "home").rglob("*") if "onnx" in each.name.lower()]
