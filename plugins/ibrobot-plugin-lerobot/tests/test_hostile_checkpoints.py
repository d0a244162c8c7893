"""A checkpoint is input from outside: a hostile one is refused before anything of it runs."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ibrobot_core.api import PolicyError

from .hostile import ATTACKS, POST, PRE, pickled_weights
from .test_checkpoint import frame, make, step, write

TYPES: dict[str, dict[str, Any]] = {
    "act": {},
    "diffusion": {"horizon": 16, "n_obs_steps": 2},
    "vqbet": {"action_chunk_size": 5},
    "smolvla": {"vlm_model_name": "HuggingFaceTB/SmolVLM2-500M-Video-Instruct"},
    "pi0": {},
}
"""Policies without steps that only LeRobot runs, so that the robot's side needs no torch."""


@pytest.mark.parametrize("kind", TYPES)
def test_harmless_checkpoint_is_accepted(tmp_path: Path, kind: str) -> None:
    make(write(tmp_path / "model", type=kind, **TYPES[kind]))


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("attack", ATTACKS)
def test_hostile_checkpoint_is_refused(tmp_path: Path, attack: str, kind: str) -> None:
    path, canary = write(tmp_path / "model", type=kind, **TYPES[kind]), tmp_path / "canary"
    ATTACKS[attack].spoil(path, canary)
    with pytest.raises(PolicyError, match=ATTACKS[attack].refusal) as message:
        make(path)
    assert str(path) in str(message.value), "the message names the file"
    assert not canary.exists()


def test_pickled_weights_are_refused_without_torch(tmp_path: Path) -> None:
    path, canary = write(tmp_path / "model"), tmp_path / "canary"
    pickled_weights(path, canary)
    with pytest.raises(PolicyError, match=r"model.safetensors: cannot be read"):
        make(path).load()
    assert not canary.exists()


def test_links_within_hugging_face_cache_are_followed(tmp_path: Path) -> None:
    real = write(tmp_path / "models--me--act/snapshots/c0ffee")
    blobs = tmp_path / "models--me--act/blobs"
    blobs.mkdir()
    for number, file in enumerate(sorted(real.iterdir())):
        file.rename(blobs / str(number))
        file.symlink_to(f"../../blobs/{number}")
    make(real)
    latest = tmp_path / "last"
    latest.symlink_to(real)
    make(latest)


def test_base_models_allow_other_models(tmp_path: Path) -> None:
    path = write(tmp_path / "model", type="smolvla", vlm_model_name="me/mine")
    with pytest.raises(PolicyError, match=r"if you trust it, allow it .* base_models: \[me/mine\]"):
        make(path)
    make(path, base_models=("me/mine",))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(["config.json", PRE, POST]), st.integers(0, 10_000), JSON)
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], derandomize=True
)
def test_mutated_checkpoint_is_accepted_or_raises_policy_error(
    tmp_path: Path, file: str, place: int, value: Any
) -> None:
    folder = tmp_path / "model"
    path = folder if folder.is_dir() else write(folder, (step("rename_observations_processor", rename_map={"a": "b"}),))
    text = (path / file).read_text()
    document = json.loads(text)
    places = list(_places(document))
    container, key = places[place % len(places)]
    container[key] = value
    (path / file).write_text(json.dumps(document))
    try:
        with contextlib.suppress(PolicyError):
            policy = make(path)
            policy.preprocess(frame(prompt="x"))
    finally:
        (path / file).write_text(text)


def _places(value: Any) -> Any:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in list(items):
        yield value, key
        yield from _places(inner)
