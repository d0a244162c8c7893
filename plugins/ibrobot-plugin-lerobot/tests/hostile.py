"""Ways to turn a checkpoint into a hostile one. Each that runs code when it is loaded creates the file `canary`."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import attrs

PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"


@attrs.frozen
class Attack:
    """How to spoil a checkpoint's folder, and what its refusal says."""

    spoil: Callable[[Path, Path], None]
    """Takes the folder and the canary."""
    refusal: str
    """Regular expression."""


def _pickled(canary: Path) -> bytes:
    """What unpickles to a call of `os.system`."""
    return f"cos\nsystem\n(S'touch {canary}'\ntR.".encode()


def _edit(path: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def _config(**values: Any) -> Callable[[Path, Path], None]:
    return lambda path, canary: _edit(path / "config.json", lambda document: document.update(values))


def _step(file: str, entry: Callable[[Path], Any]) -> Callable[[Path, Path], None]:
    return lambda path, canary: _edit(path / file, lambda document: document["steps"].append(entry(canary)))


def _state_file(name: Any) -> Callable[[Path, Path], None]:
    def spoil(path: Path, canary: Path) -> None:
        states = [path / PRE, path / POST]
        for file in states:
            _edit(file, lambda document: [s.update(state_file=name) for s in document["steps"] if "state_file" in s])

    return spoil


def _linked(name: str, target: Callable[[Path], Path]) -> Callable[[Path, Path], None]:
    def spoil(path: Path, canary: Path) -> None:
        there = target(path)
        if not there.exists():
            (path / name).replace(there)
        (path / name).unlink(missing_ok=True)
        (path / name).symlink_to(there)

    return spoil


def _fifo(path: Path, canary: Path) -> None:
    (path / "config.json").unlink()
    os.mkfifo(path / "config.json")


def _sparse(name: str, size: int) -> Callable[[Path, Path], None]:
    def spoil(path: Path, canary: Path) -> None:
        with (path / name).open("r+b") as file:
            file.truncate(size)

    return spoil


def _statistics(path: Path) -> Path:
    document = json.loads((path / POST).read_text())
    return path / next(step["state_file"] for step in document["steps"] if "state_file" in step)


def _header(size: int, header: bytes) -> Callable[[Path, Path], None]:
    """Statistics that say that their header has `size` bytes."""
    return lambda path, canary: _write(_statistics(path), size.to_bytes(8, "little") + header)


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _pickled_statistics(path: Path, canary: Path) -> None:
    _statistics(path).write_bytes(_pickled(canary))


def _zip(canary: Path) -> bytes:
    """As `torch.save` writes."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("archive/data.pkl", _pickled(canary))
        archive.writestr("archive/version", "3\n")
    return file.getvalue()


def _deep(name: str) -> Callable[[Path, Path], None]:
    return lambda path, canary: _write(path / name, b'{"steps": ' + b"[" * 10_000 + b"]" * 10_000 + b"}")


def _deeper_than_any(path: Path, canary: Path) -> None:
    nested: Any = 0
    for _ in range(60):
        nested = [nested]
    _edit(path / "config.json", lambda document: document.update(extra=nested))


def _remote_code(canary: Path) -> dict[str, Any]:
    """A tokeniser in a folder of its own, whose Python runs where remote code is trusted."""
    folder = canary.parent / "tokeniser"
    folder.mkdir(exist_ok=True)
    (folder / "evil.py").write_text(f"open({str(canary)!r}, 'w')\nclass Evil: pass\n")
    names = {"AutoTokenizer": ["evil.Evil", None], "AutoProcessor": "evil.Evil"}
    (folder / "tokenizer_config.json").write_text(json.dumps({"auto_map": names}))
    (folder / "processor_config.json").write_text(json.dumps({"auto_map": names, "processor_class": "Evil"}))
    return {"action_tokenizer_name": str(folder), "paligemma_tokenizer_name": str(folder), "trust_remote_code": True}


def _shell(canary: Path) -> dict[str, Any]:
    return {"class": "os.system", "config": {"command": f"touch {canary}"}}


def _features(**changes: Any) -> Callable[[Path, Path], None]:
    return lambda path, canary: _edit(
        path / "config.json", lambda document: document["input_features"]["observation.state"].update(changes)
    )


_OUTSIDE = r"links to .*, outside the checkpoint"
_NAMES_ANOTHER = r"loads .* in addition to the checkpoint"

ATTACKS = {
    "shell": Attack(_step(PRE, _shell), r"step 'os.system' is not a processor step of LeRobot"),
    "shell_after": Attack(_step(POST, _shell), r"step 'os.system' is not a processor step of LeRobot"),
    "class_of_another_package": Attack(
        _step(PRE, lambda canary: {"class": "subprocess.Popen", "config": {"args": ["touch", str(canary)]}}),
        r"step 'subprocess.Popen' is not a processor step",
    ),
    "class_that_looks_like_lerobots": Attack(
        _step(PRE, lambda _: {"class": "lerobotx.Step"}), r"step 'lerobotx.Step' is not a processor step"
    ),
    "class_up_and_out": Attack(
        _step(PRE, lambda _: {"class": "lerobot..os.system"}), r"step 'lerobot..os.system' is not a processor step"
    ),
    "class_behind_an_empty_name": Attack(
        _step(PRE, lambda canary: {"registry_name": "", **_shell(canary)}), r"registry_name of a step is ''"
    ),
    "class_behind_no_name": Attack(
        _step(PRE, lambda canary: {"registry_name": None, **_shell(canary)}), r"registry_name of a step is None"
    ),
    "step_without_a_name": Attack(_step(PRE, lambda _: {"config": {}}), r"class of a step is None"),
    "step_that_is_no_object": Attack(_step(PRE, lambda _: "os.system"), r"a step is a str"),
    "step_whose_config_is_no_object": Attack(
        _step(PRE, lambda _: {"registry_name": "to_batch_processor", "config": 3}), r"config of step .* is a int"
    ),
    "step_that_runs_remote_code": Attack(
        _step(PRE, lambda canary: {"registry_name": "action_tokenizer_processor", "config": _remote_code(canary)}),
        r"step 'action_tokenizer_processor' runs downloaded code",
    ),
    "remote_code_by_default": Attack(
        _step(PRE, lambda canary: {"registry_name": "topreward_encoder", "config": {"vlm_name": "any/body"}}),
        r"step 'topreward_encoder' runs downloaded code",
    ),
    "trust_remote_code": Attack(_config(trust_remote_code=True), r"trust_remote_code"),
    "trust_remote_code_below": Attack(_config(a={"b": [{"trust_remote_code": 1}]}), r"a.b.0.trust_remote_code"),
    "policy_that_runs_remote_code": Attack(
        _config(type="groot"), r"policies of type 'groot' are not supported: LeRobot runs downloaded code"
    ),
    "type_that_is_no_text": Attack(_config(type=["act"]), r"type is \['act'\]"),
    "tokenizer_in_a_folder": Attack(
        _step(PRE, lambda canary: {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "/tmp/x"}}),
        r"tokenizer_name " + _NAMES_ANOTHER,
    ),
    "tokenizer_of_anybody": Attack(
        _step(PRE, lambda canary: {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "evil"}}),
        r"tokenizer_name loads 'evil' in addition to the checkpoint",
    ),
    "vlm_of_anybody": Attack(_config(vlm_model_name="any/body"), r"vlm_model_name loads 'any/body' in addition to"),
    "vlm_up_and_out": Attack(_config(vlm_model_name="../other"), r"vlm_model_name " + _NAMES_ANOTHER),
    "a_path_in_any_field": Attack(_config(whatever="/etc/passwd"), r"whatever loads '/etc/passwd' in addition to"),
    "a_url_in_any_field": Attack(_config(whatever="http://x"), r"whatever loads 'http://x' in addition to"),
    "a_home_in_any_field": Attack(_config(whatever="~root"), r"whatever loads '~root' in addition to"),
    "state_file_absolute": Attack(_state_file("/etc/passwd"), r"state_file '/etc/passwd' is not the plain name"),
    "state_file_up_and_out": Attack(_state_file("../x.safetensors"), r"state_file '../x.safetensors' is not the plain"),
    "state_file_in_a_folder": Attack(_state_file("a/x.safetensors"), r"state_file 'a/x.safetensors' is not the plain"),
    "state_file_is_a_list": Attack(_state_file(["x"]), r"state_file \['x'\] is not the plain name"),
    "state_file_has_a_null": Attack(_state_file("x\0.safetensors"), r"is not the plain name"),
    "state_file_is_pickled": Attack(_state_file("x.pkl"), r"state_file 'x.pkl' is not the plain name"),
    "config_linked_out": Attack(_linked("config.json", lambda path: path.parent / "outside.json"), _OUTSIDE),
    "processor_linked_out": Attack(_linked(PRE, lambda path: path.parent / "outside.json"), _OUTSIDE),
    "config_is_a_device": Attack(_linked("config.json", lambda _: Path("/dev/zero")), _OUTSIDE),
    "config_is_a_pipe": Attack(_fifo, r"config.json: is not a regular file"),
    "config_is_large": Attack(_sparse("config.json", 1 << 34), r"config.json: has 17179869184 bytes"),
    "statistics_are_large": Attack(
        lambda path, canary: _sparse(_statistics(path).name, 1 << 36)(path, canary), r"has 68719476736 bytes"
    ),
    "statistics_are_pickled": Attack(_pickled_statistics, r"safetensors: cannot be read"),
    "statistics_are_torchs": Attack(
        lambda path, canary: _write(_statistics(path), _zip(canary)), r"safetensors: cannot be read"
    ),
    "statistics_with_a_huge_header": Attack(_header(1 << 62, b"{}"), r"safetensors: cannot be read"),
    "statistics_with_a_deep_header": Attack(
        _header(40_000, b'{"a":' + b"[" * 19_995 + b"]" * 19_995 + b"     "), r"safetensors: cannot be read"
    ),
    "statistics_beyond_their_end": Attack(
        _header(64, b'{"a":{"dtype":"F32","shape":[99999999],"data_offsets":[0,4]}}   '), r"safetensors: cannot be read"
    ),
    "config_is_deep": Attack(_deep("config.json"), r"config.json: is nested more than"),
    "processor_is_deep": Attack(_deep(PRE), r"policy_preprocessor.json: is nested more than"),
    "config_is_a_little_too_deep": Attack(_deeper_than_any, r"config.json: is nested more than"),
    "config_is_no_unicode": Attack(lambda p, c: _write(p / "config.json", b'{"type": "\xff"}'), r"cannot be read"),
    "long_chunks": Attack(_config(chunk_size=1e9, n_action_steps=1e9), r"(chunk_size|n_action_steps) is 1000000000.0"),
    "longer_chunks": Attack(
        _config(chunk_size=10**9, n_action_steps=10**9), r"(chunk_size|n_action_steps) is 1000000000"
    ),
    "endless_chunks": Attack(_config(chunk_size=1e999, n_action_steps=1e999), r"(chunk_size|n_action_steps) is inf"),
    "no_chunks": Attack(_config(chunk_size=-1, n_action_steps=-1), r"(chunk_size|n_action_steps) is -1"),
    "long_history": Attack(_config(n_obs_steps=10**9), r"n_obs_steps is 1000000000"),
    "history_in_words": Attack(_config(n_obs_steps="many"), r"n_obs_steps is 'many'"),
    "large_picture": Attack(
        lambda path, canary: _edit(
            path / "config.json",
            lambda document: [
                feature.update(shape=[3, 100_000, 100_000])
                for feature in document["input_features"].values()
                if feature["type"] == "VISUAL"
            ],
        ),
        r"shape of .* is \[3, 100000, 100000\]",
    ),
    "large_network": Attack(_config(dim_model=10**9), r"dim_model is 1000000000"),
    "large_observation": Attack(_features(shape=[10**9]), r"observation.state.shape.0 is 1000000000"),
    "negative_observation": Attack(_features(shape=[-6]), r"shape of observation.state is \[-6\]"),
    "observation_in_words": Attack(_features(shape=["six"]), r"shape of observation.state is \['six'\]"),
}


def pickled_weights(path: Path, canary: Path) -> None:
    """Weights that run code when they are unpickled, under the name of those that cannot."""
    (path / "model.safetensors").write_bytes(_zip(canary))
