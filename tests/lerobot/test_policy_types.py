"""The table of LeRobot's policy types: each type of the installed LeRobot is tried, and the page says the same."""

from __future__ import annotations

import json
import shutil
import sys
from importlib import import_module, invalidate_caches
from pathlib import Path
from pkgutil import iter_modules

import lerobot.policies
import pytest
from ibrobot_lerobot.options import LeRobotPolicyOptions
from ibrobot_lerobot.policy import LeRobotPolicy
from ibrobot_lerobot.policy_types import POLICY_TYPES
from ibrobot_testing.contexts import host_context
from lerobot.configs.policies import PreTrainedConfig

from ibrobot_core.errors import PolicyError

sys.path.insert(0, str(Path(__file__).parent))
from checkpoints import CONFIGS, STATE, TOP, act, features, save
from test_large_policies import LARGE

pytestmark = pytest.mark.lerobot
PAGE = Path(__file__).parents[2] / "docs/how-to/run-a-policy.md"


def types_of_lerobot() -> list[str]:
    """The names of all policy types of the installed LeRobot."""
    (folder,) = lerobot.policies.__path__
    for package in (each.name for each in iter_modules([folder]) if each.ispkg):
        for module in iter_modules([f"{folder}/{package}"]):
            if module.name.startswith("configuration"):
                import_module(f"lerobot.policies.{package}.{module.name}")
    known = PreTrainedConfig.get_known_choices()
    return sorted(name for name, each in known.items() if each.__module__.startswith("lerobot."))


def policy(path: Path) -> LeRobotPolicy:
    return LeRobotPolicy(LeRobotPolicyOptions(path=path), host_context())


def test_the_table_has_each_type_of_lerobot_and_the_page_has_the_table() -> None:
    assert sorted(POLICY_TYPES) == types_of_lerobot()
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    for name, known in POLICY_TYPES.items():
        assert f"| `{name}` | {known.state} | {known.why} |" in rows


@pytest.mark.parametrize("name", [name for name, known in POLICY_TYPES.items() if known.state == "refused"])
def test_a_refused_type_says_why(name: str, tmp_path: Path) -> None:
    types_of_lerobot()
    PreTrainedConfig.get_known_choices()[name](**features(STATE, TOP)).save_pretrained(tmp_path)
    with pytest.raises(PolicyError, match=f"policies of type '{name}' are not supported: ") as error:
        policy(tmp_path)
    assert POLICY_TYPES[name].why in str(error.value)


def test_each_type_that_runs_has_a_network_in_these_tests() -> None:
    assert {name for name, known in POLICY_TYPES.items() if known.state == "runs"} == {*CONFIGS, "smolvla", *LARGE}


def test_each_type_that_does_not_run_says_why() -> None:
    assert not [name for name, known in POLICY_TYPES.items() if bool(known.why) is (known.state == "runs")]


OTHERS = """
from dataclasses import dataclass
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.act.configuration_act import ACTConfig

@PreTrainedConfig.register_subclass("other_act")
@dataclass
class OtherActConfig(ACTConfig):
    pass
"""
MODEL = """
from lerobot.policies.act.modeling_act import ACTPolicy

class OtherActPolicy(ACTPolicy):
    name = "other_act"
"""


def test_a_policy_of_another_package_is_found_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(act(), tmp_path / "checkpoint")
    config = json.loads((path / "config.json").read_text())
    (path / "config.json").write_text(json.dumps({**config, "type": "other_act"}))
    with pytest.raises(
        PolicyError, match=r"LeRobot has no policy type 'other_act'; packages named lerobot_policy_\* add"
    ):
        policy(path).load()

    site = tmp_path / "site"
    package = site / "lerobot_policy_other"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("from .configuration_other_act import OtherActConfig\n")
    (package / "configuration_other_act.py").write_text(OTHERS)
    (package / "modeling_other_act.py").write_text(MODEL)
    metadata = site / "lerobot_policy_other-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot-policy-other\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(str(site))
    invalidate_caches()
    found = policy(path)
    found.load()
    assert found.spec.chunk_size == act().chunk_size
    found.close()

    shutil.rmtree(package)
    for module in [name for name in sys.modules if name.startswith("lerobot_policy_other")]:
        del sys.modules[module]
