"""Hostile checkpoints run nothing where LeRobot and torch are installed, which would run it."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_lerobot.policy_types import check_type
from ibrobot_lerobot.untrusted import BASE_MODELS, check_step_name, names_a_model
from ibrobot_testing.contexts import host_context
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor.pipeline import ProcessorStepRegistry

from ibrobot_core.errors import PolicyError

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[2] / "plugins/ibrobot-plugin-lerobot/tests"))
from checkpoints import CONFIGS, act, save
from hostile import ATTACKS, PRE, pickled_weights

pytestmark = pytest.mark.lerobot

_PACKAGE = Path(find_spec("lerobot").submodule_search_locations[0])  # type: ignore[union-attr, index]
_TRUSTS = "trust_remote_code"


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("originals")
    return {name: save(config(), root / name) for name, config in CONFIGS.items()}


def load(path: Path) -> None:
    LeRobotPolicy(LeRobotPolicyOptions(path, device="cpu", threads=1), host_context()).load()


@pytest.mark.parametrize("kind", CONFIGS)
def test_hostile_checkpoints_are_refused(tmp_path: Path, originals: dict[str, Path], kind: str) -> None:
    for name, attack in ATTACKS.items():
        path, canary = tmp_path / name, tmp_path / f"{name}.canary"
        shutil.copytree(originals[kind], path)
        attack.spoil(path, canary)
        with pytest.raises(PolicyError, match=attack.refusal):
            load(path)
        assert not canary.exists(), name
        shutil.rmtree(path)


def test_lerobot_itself_runs_the_shell_step(tmp_path: Path, originals: dict[str, Path]) -> None:
    """The attack is a real one: without our check, the command runs."""
    path, canary = shutil.copytree(originals["act"], tmp_path / "act"), tmp_path / "canary"
    ATTACKS["shell"].spoil(path, canary)
    with pytest.raises(TypeError):
        make_pre_post_processors(PreTrainedConfig.from_pretrained(path), pretrained_path=str(path))
    assert canary.exists()


@pytest.mark.parametrize(
    ("name", "refusal"),
    [
        ("lerobot.processor.pipeline.Path", "is not a processor step of LeRobot"),
        ("lerobot.processor.pipeline.json", "is not a processor step of LeRobot"),
        ("lerobot.processor.nothing.Step", "cannot be imported"),
        ("lerobot.processor.tokenizer_processor.ActionTokenizerProcessorStep", "action_tokenizer_processor' runs"),
    ],
)
def test_classes_below_lerobot_must_be_harmless_steps(
    tmp_path: Path, originals: dict[str, Path], name: str, refusal: str
) -> None:
    path = shutil.copytree(originals["act"], tmp_path / "act")
    document = json.loads((path / PRE).read_text())
    (path / PRE).write_text(json.dumps({"steps": [*document["steps"], {"class": name, "config": {}}]}))
    with pytest.raises(PolicyError, match=refusal):
        load(path)


def test_a_step_by_its_class_is_run(tmp_path: Path, originals: dict[str, Path]) -> None:
    path = shutil.copytree(originals["act"], tmp_path / "act")
    document = json.loads((path / PRE).read_text())
    entry = {"class": "lerobot.processor.newline_task_processor.NewLineTaskProcessorStep", "config": {}}
    (path / PRE).write_text(json.dumps({"steps": [*document["steps"], entry]}))
    load(path)


def test_pickled_weights_do_not_run(tmp_path: Path, originals: dict[str, Path]) -> None:
    path, canary = shutil.copytree(originals["act"], tmp_path / "act"), tmp_path / "canary"
    pickled_weights(path, canary)
    with pytest.raises(PolicyError, match=r"model.safetensors: cannot be read"):
        load(path)
    assert not canary.exists()


def _refused(check: Any, name: str) -> bool:
    try:
        check(Path("x"), name)
    except PolicyError:
        return True
    return False


def test_whatever_of_lerobot_trusts_remote_code_is_refused() -> None:
    """A later LeRobot that trusts it elsewhere is noticed here."""
    for file in (*_PACKAGE.glob("policies/**/*.py"), *_PACKAGE.glob("processor/**/*.py")):
        if not any(_TRUSTS in line and "(no " not in line for line in file.read_text().splitlines()):
            continue
        inner = file.relative_to(_PACKAGE)
        module = ".".join(("lerobot", *inner.with_suffix("").parts))
        steps = [name for name, step in ProcessorStepRegistry._registry.items() if step.__module__ == module]
        if inner.parts[0] == "policies":
            assert _refused(check_type, inner.parts[1]), f"{file} trusts remote code"
        else:
            assert any(_refused(check_step_name, name) for name in steps), f"{file} trusts remote code"
    for name in ("robometer_encoder", "topreward_encoder", "reward_classifier_processor", "groot_n1_7_vlm_encode_v1"):
        assert _refused(check_step_name, name)


def test_whatever_lerobots_configurations_load_is_known() -> None:
    """Every default that names a model is recognised as one, and allowed unless the policy is refused altogether."""
    seen = set()
    for kind, config in PreTrainedConfig.get_known_choices().items():
        if _refused(check_type, kind):
            continue
        for field in dataclasses.fields(config):
            value = field.default
            if isinstance(value, str) and names_a_model(field.name, value):
                assert value in BASE_MODELS, f"{kind}.{field.name}: {value}"
                seen.add(value)
            elif isinstance(value, str):
                assert value.count("/") != 1 or " " in value, f"{kind}.{field.name}: {value} looks like a model"
    assert seen >= {"HuggingFaceTB/SmolVLM2-500M-Video-Instruct", "facebook/bart-large"}


def test_registered_steps_that_are_refused_are_few() -> None:
    assert not any(_refused(check_step_name, name) for name in ("tokenizer_processor", "normalizer_processor"))


def test_fields_of_training_are_no_sizes(tmp_path: Path) -> None:
    load(save(act(optimizer_lr=1e-5), tmp_path / "act"))
