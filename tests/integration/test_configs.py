"""Every robot YAML of this repository is good, with the plugins of this repository."""

from __future__ import annotations

from pathlib import Path

import attrs
import jsonschema
import pytest

from ibrobot_core.config import load_config
from ibrobot_core.config.jsonschema import json_schema
from ibrobot_core.config.show import to_yaml
from ibrobot_core.plugins import installed_plugins

CONFIGS = sorted((Path(__file__).parents[2] / "configs").glob("*.yaml"))

pytestmark = pytest.mark.integration


def test_there_are_configs() -> None:
    assert "so101.yaml" in [path.name for path in CONFIGS]


def test_every_plugin_here_works() -> None:
    assert installed_plugins().failures == []


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_config_passes_check_and_schema(path: Path) -> None:
    config = load_config(path)

    jsonschema.Draft202012Validator(json_schema(installed_plugins())).validate(config.document)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_what_show_prints_is_the_same_config(path: Path, tmp_path: Path) -> None:
    config = load_config(path)
    again = tmp_path / path.name
    again.write_text(to_yaml(config))

    loaded = attrs.evolve(load_config(again), source=config.source, document={})

    assert loaded == attrs.evolve(config, document={})
