"""The model asked again: bit for bit what it answered, from the recording alone; else whose the difference is."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import torch
from ibrobot_diagnose.ask_again import model_of
from ibrobot_diagnose.references import read_episode
from ibrobot_testing import host_context, ibrobot_command
from ibrobot_testing.ports import free_port
from safetensors.torch import load_file, save_file

from ibrobot_core.app import installed_plugins

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import EVERYWHERE, SCENE, STATE, TOP, act, diffusion, features, save, statistics, vqbet
from command_line import run_here

pytestmark = pytest.mark.lerobot

CONFIG = Path(__file__).parents[2] / "configs" / "so101_pick_cube.yaml"
PERIPHERALS = "".join(
    f"\n  - {{name: {name}, kind: camera, type: opencv, device: {name}, width: 96, height: 96}}"
    for name in ("top", "wrist")
)
OBSERVED = "".join(
    f"    - {{key: observation.images.{name}, peripheral: {name}, image: {{resize: [96, 96]}}, "
    "align: {strategy: asof, stamp: header, tol_ms: 200}}\n"
    for name in ("top", "wrist")
)
NOT_ALL_SUCCEEDED = 3
MODES = ("monolithic", "process", "distributed")
KINDS: dict[str, Callable[..., Any]] = {
    "act": partial(act, **features(STATE, TOP, "observation.images.wrist")),
    "diffusion": diffusion,
    "vqbet": vqbet,
}
"""Each sees pictures."""
_DURATION_S = {"blind": 2}
"""Of its run, if it takes more than six answers to judge it [s]."""


def robot(path: Path) -> Path:
    """The simulated SO-101 with two small cameras."""
    text = CONFIG.read_text(encoding="utf-8").replace("\nexecutors:", f"\nperipherals:{PERIPHERALS}\n\nexecutors:", 1)
    text = text.replace("    - {key: observation.environment_state", f"{OBSERVED}    - {{key: {SCENE}", 1)
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("asked")


@contextmanager
def served(checkpoint: Path) -> Iterator[str]:
    """A server of a checkpoint; its address."""
    # Zenoh's own threads run from here on, with the files that they keep.
    zenoh, endpoint = installed_plugins().find("transport", "zenoh"), f"tcp/127.0.0.1:{free_port()}"
    router = zenoh.make(zenoh.options(mode="router", listen=(endpoint,)), host_context())
    zenoh.make(zenoh.options(connect=(endpoint,)), host_context()).close()
    router.close()
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    words = ("serve", checkpoint, "--type", "lerobot", "--name", "act", "--set", "threads=1", "--listen", endpoint)
    server = subprocess.Popen([*ibrobot_command(), *map(str, words)], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        assert server.stdout.readline().startswith("serving act")
        yield endpoint
    finally:
        server.terminate()
        server.communicate(timeout=60)


def checkpoint_of(root: Path, kind: str, mode: str) -> Path:
    """The checkpoint of a kind of policy; one that another process can load too, unless this one runs it."""
    path = root / (kind if mode == "monolithic" else f"{kind}-everywhere")
    return path if path.exists() else save(KINDS[kind](**({} if mode == "monolithic" else EVERYWHERE)), path)


def record(root: Path, kind: str, mode: str, endpoint: str = "") -> Path:
    """A run of a kind of policy with an execution mode, recorded."""
    network = ("--set", f"transport={{type: zenoh, connect: [{endpoint}]}}") if endpoint else ()
    done = run_here(
        "launch", robot(root / "cube.yaml"), "--sim", "--headless", "--lockstep", "--episodes", 1,
        "--mode", "learned", "--set", f"contract.max_duration_s={_DURATION_S.get(kind, 0.2)}",
        "--set", "models.act.threads=1",
        "--set", f"models.act.path={checkpoint_of(root, kind, mode)}", "--set", f"recording.root={root / kind}-{mode}",
        "--set", "recording.type=mcap",
        "--set", f"control_modes.learned.inference.execution_mode={mode}", *network,
    )  # fmt: skip
    assert done.returncode in (0, NOT_ALL_SUCCEEDED), done.stderr
    return next(Path(f"{root / kind}-{mode}").glob("*/episodes/episode_*"))


@pytest.fixture(scope="module")
def recorded(root: Path) -> Callable[[str], Path]:
    """A run of a kind of policy in the run's own process, recorded once."""
    return cache(lambda kind: record(root, kind, "monolithic"))


@pytest.fixture(scope="module")
def answered(request: pytest.FixtureRequest, root: Path, recorded: Callable[[str], Path]) -> Iterator[tuple[Path, str]]:
    """A recorded run, and the address of the server that computed its answers; empty without one.

    A fixture of the module, since the server lives until the test's own leaks have been looked for.
    """
    kind, mode = request.param
    if mode == "monolithic":
        yield recorded(kind), ""
    elif mode == "process":
        yield record(root, kind, mode), ""
    else:
        with served(checkpoint_of(root, kind, mode)) as endpoint:
            yield record(root, kind, mode, endpoint), endpoint


def facts_of(episode: Path, *words: object) -> dict[str, Any]:
    done = run_here("explain", episode, "--json", "--model", *words)
    assert done.returncode == 0, done.stderr
    facts: dict[str, Any] = json.loads(done.stdout)[0]
    return facts


def asked_again(
    episode: Path, given: str = "", server: str = "", change: Callable[[Any], Any] = lambda model: model
) -> tuple[int, int, str]:
    """How many answers there are and how many are equal, and whose a difference is; the model may be changed first."""
    model = change(model_of(read_episode(episode), episode, given, server))
    model.load()
    try:
        again = tuple(model.again())
        return len(again), sum(each.equal for each in again), str(model.whose(again))
    finally:
        model.close()


ASKED = [
    # In a child or on a server, a model answers as in the run's process: test_execution.py.
    pytest.param(
        (kind, mode), marks=[] if (kind, mode) == ("act", "monolithic") else [pytest.mark.long], id=f"{kind}-{mode}"
    )
    for kind in KINDS
    for mode in MODES
]


@pytest.mark.parametrize("answered", ASKED, indirect=True)
def test_answers_are_equal_bit_for_bit(answered: tuple[Path, str]) -> None:
    episode, endpoint = answered
    for server in {"", endpoint}:
        asked, equal, whose = asked_again(episode, server=server)
        assert asked >= 2
        assert (equal, whose) == (asked, "")


def other_weights(path: Path) -> None:
    tensors = load_file(path / "model.safetensors")
    name = next(each for each in tensors if each.endswith("action_head.bias"))
    save_file({**tensors, name: tensors[name] + 0.01}, path / "model.safetensors", {"format": "pt"})


def other_statistics(path: Path) -> None:
    weights = (path / "model.safetensors").read_bytes()
    save(KINDS["act"](), path, statistics(seed=1))
    (path / "model.safetensors").write_bytes(weights)


@pytest.mark.parametrize(
    ("change", "whose"),
    [(other_weights, "the weights are others"), (other_statistics, "the checkpoint's processors")],
)
def test_another_checkpoint_is_named(change: Any, whose: str, root: Path, recorded: Any, tmp_path: Path) -> None:
    episode = recorded("act")
    changed = shutil.copytree(root / "act", tmp_path / "act")
    change(changed)
    asked, equal, said = asked_again(episode, str(changed))
    assert equal < asked
    assert said.startswith(whose)


@pytest.mark.long
def test_policy_that_ignores_its_pictures_is_named(root: Path, recorded: Any) -> None:
    blind = save(KINDS["act"](), root / "blind")
    tensors = load_file(blind / "model.safetensors")
    seen = "model.encoder_img_feat_input_proj.weight"
    save_file({**tensors, seen: torch.zeros_like(tensors[seen])}, blind / "model.safetensors", {"format": "pt"})
    facts = facts_of(recorded("blind"), ".")
    (ignored,) = (each for each in facts["causes"] if each["name"] == "camera_ignored")
    assert ignored["text"].startswith("The policy ignores its pictures, of all cameras")
    assert ignored["likelihood"] > 0.9
    changes: dict[str, set[str]] = {}
    for each in facts["model"]["effects"]:
        changes.setdefault(each["what"], set()).add(each["change"])
        assert len(each["rad"]) == 6
    pictures = {"black", "BGR for RGB", "upside down", "mirrored", "shifted by a tenth", "replaced by its mean"}
    assert pictures <= changes["top"] == changes["wrist"]
    units = {"in degrees", "from -100 to 100", "in reverse order", "shifted by 0.2 rad", "replaced by zeros"}
    assert units <= changes["state"]
    assert {"replaced by zero", "replaced by its mean", "shifted by 0.2 rad"} <= changes["state shoulder_pan"]
    assert changes["top and wrist"] == {"exchanged"}


def test_attention_is_shown_over_the_pictures(recorded: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_diagnose.ask_again._MOST", 2)  # of the effects, the test above
    episode = recorded("act")
    model = model_of(read_episode(episode), episode, "")
    model.load()
    try:
        first = next(iter(model.frames(model.window.asked[:1])))
        weights = model.attention(first)
    finally:
        model.close()
    assert {key: each.shape for key, each in weights.items()} == {TOP: (3, 3), "observation.images.wrist": (3, 3)}
    assert 0.1 < sum(float(each.sum()) for each in weights.values()) < 1.0
    done = run_here("explain", episode, "--model", ".", "--out", tmp_path / "report")
    assert "camera_ignored" not in done.stdout
    assert (tmp_path / "report/report.html").read_text().count("% of what the model attends to") >= 2


def whose(episode: Path, change: Callable[[Any], Any]) -> str:
    """What is said of the answers if the model that is asked, or the recording, is changed."""
    return asked_again(episode, change=change)[2]


def with_document(model: Any, **changes: Any) -> Any:
    """The model of a recording whose robot YAML says something else."""
    window = model.window
    metadata = {**window.metadata, "config": json.dumps({**window.document, **changes})}
    return model_of(attrs.evolve(window, metadata=metadata), model._episode, "")


def test_another_contract_is_named(recorded: Any) -> None:
    episode = recorded("act")

    def exchanged(model: Any) -> Any:
        contract = json.loads(json.dumps(model.window.document["contract"]))
        one, other = (each for each in contract["observations"] if each["key"] in (TOP, "observation.images.wrist"))
        one["peripheral"], other["peripheral"] = other["peripheral"], one["peripheral"]
        return with_document(model, contract=contract)

    assert whose(episode, exchanged).startswith("the contract is another: observation.images.")


def changed_answers(model: Any, **changes: Any) -> Any:
    """The model with other recorded answers."""
    asked = tuple(
        attrs.evolve(each, chunk=each.chunk + 1e-9, answer=attrs.evolve(each.answer, **changes))
        for each in model.window.asked
    )
    model.window = attrs.evolve(model.window, asked=asked)
    return model


@pytest.mark.parametrize(
    ("server", "said"),
    [
        ("lerobot 0.5.0, torch {torch}, cpu, {cpu}, threads 1", "the library is another: lerobot 0.5.0 acted"),
        ("lerobot {lerobot}, torch {torch}, cuda", "the program is another: lerobot"),
        ("lerobot {lerobot}, torch {torch}, cpu, NEON, threads 1", "the processor is another: NEON acted"),
        ("lerobot {lerobot}, torch {torch}, cpu, {cpu}, threads 4", "the number of threads is another: threads 4"),
    ],
)
def test_other_libraries_and_processors_are_named(server: str, said: str, recorded: Any) -> None:
    episode = recorded("act")
    here = {
        "torch": version("torch"), "lerobot": version("lerobot"), "cpu": torch.backends.cpu.get_cpu_capability(),
    }  # fmt: skip
    assert whose(episode, lambda model: changed_answers(model, server=server.format(**here))).startswith(said)


def test_another_picture_is_named(recorded: Any) -> None:
    episode = recorded("act")
    window = read_episode(episode)
    at_ns = sorted(each.answer.observed_ns for each in window.asked)[1]

    def other(model: Any) -> Any:
        def frames(asked: Any) -> Any:
            for frame in type(model).frames(model, asked):
                places = 9 if frame.stamp_ns == at_ns else 0
                values = {k: np.roll(v, places, axis=1) if v.ndim == 3 else v for k, v in frame.values.items()}
                yield attrs.evolve(frame, values=values)

        model.frames = frames
        return model

    said = whose(episode, other)
    assert said.startswith("an observation: ")
    assert f"at {window.since(at_ns):.2f} s" in said
