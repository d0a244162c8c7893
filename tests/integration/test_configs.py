"""Every robot YAML of this repository is good, with the plugins of this repository."""

from __future__ import annotations

import json
from pathlib import Path

import attrs
import jsonschema
import pytest
from click.testing import CliRunner
from ibrobot_import.schema import json_schema

from ibrobot_core.cli.main import cli
from ibrobot_core.config import load_config
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


@pytest.mark.parametrize("fits", [True, False])
def test_check_reads_a_calibration_whose_joints_are_numbers_as_a_run_does(tmp_path: Path, fits: bool) -> None:
    """IB-Robot's files have the servos' numbers; the joints are those of the hardware, in its order."""
    (tmp_path / "arm.json").write_text(
        json.dumps(
            {
                str(number): {
                    "homing_offset": 0,
                    "range_min": 900 if fits else 2000,
                    "range_max": 3196 if fits else 2096,
                }
                for number in range(1, 7)
            }
        )
    )
    given = [
        f"--set=hardware.calibration={tmp_path}/arm.json",
        f"--set=teleoperation.leader.calibration={tmp_path}/arm.json",
    ]
    so101 = next(path for path in CONFIGS if path.stem == "so101")
    done = CliRunner().invoke(cli, ["config", "check", "--deep", "--mode", "teleop", *given, str(so101)])
    if fits:
        assert done.exit_code == 0, done.exception
    else:
        assert "shoulder_pan: its range, " in str(done.exception)


def test_schema_is_printed_with_the_keys_of_a_robot_yaml() -> None:
    schema = json.loads(CliRunner().invoke(cli, ["config", "schema"], catch_exceptions=False).output)
    jsonschema.Draft202012Validator.check_schema(schema)
    assert {"robot", "contract", "control_modes", "hardware"} <= set(schema["properties"])
    wrong = jsonschema.Draft202012Validator(schema["properties"]["control"]).iter_errors({"rate_hz": "fast"})
    assert [list(each.absolute_path) for each in wrong] == [["rate_hz"]]
