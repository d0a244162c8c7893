"""`ibrobot config import` with all plugins: imported robots are checked, planned and run in simulation."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import run_here
from ibrobot_calibration import JointCalibration
from ibrobot_calibration.joint_units import calibrations, radians_to_lerobot
from ibrobot_data.config_metadata import load_contract
from ibrobot_feetech.ticks import TICKS_PER_RADIAN
from lerobot_units import normalised

from ibrobot_core.app import load_config

FILES = Path(__file__).parents[2] / "plugins" / "ibrobot-plugin-import" / "tests" / "files"
ROBOTS = sorted(path.name for path in FILES.iterdir() if "base" not in path.name and "contract" not in path.name)


@pytest.mark.parametrize("name", ROBOTS)
def test_imported_robot_is_checked_and_runs_in_simulation(name: str, tmp_path: Path) -> None:
    new = tmp_path / "new.yaml"
    imported = run_here("config", "import", FILES / name, new)
    assert imported.returncode == 0, imported.stderr
    assert "note:" not in imported.stdout
    assert run_here("config", "check", new).returncode == 0
    planned = run_here("launch", new, "--dry-run", "--mode", "hold", "--json")
    assert planned.returncode == 0, planned.stderr
    run = run_here("launch", new, "--sim", "--lockstep", "--headless", "--duration", "0.2", "--json")
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout.splitlines()[-1])["faults"] == []


@pytest.mark.parametrize("name", sorted(path.name for path in FILES.iterdir()))
def test_foreign_file_is_named_with_the_command_that_takes_it(name: str) -> None:
    program = (
        name.partition("_")[0].replace("ib", "IB-Robot").replace("lerobot", "LeRobot").replace("rosetta", "Rosetta")
    )
    for command in ("check", "show"):
        refused = run_here("config", command, FILES / name)
        assert refused.returncode == 2
        assert program in refused.stderr
        assert refused.stderr.endswith(f": ibrobot config import {FILES / name}\n")
    assert f"ibrobot config import {FILES / name}" in run_here("launch", FILES / name, "--sim").stderr


def test_calibration_of_lerobot_gives_the_same_angles_from_the_same_ticks(tmp_path: Path) -> None:
    file, new = FILES / "lerobot_calibration.json", tmp_path / "new.yaml"
    assert run_here("config", "import", file, new).returncode == 0
    (found,) = calibrations(load_config(new)).values()
    assert list(found) == list(numbers := json.loads(file.read_text()))
    for name, fields in found.items():
        joint = JointCalibration(**fields)
        assert joint.numbers() == numbers[name]
        mode = "range_0_100" if name == "gripper" else "degrees"
        ticks = np.linspace(joint.range_min, joint.range_max, 50).round()
        sign = -1.0 if joint.inverted else 1.0
        angles = (ticks - joint.zero(joint.closed_at)) * sign / TICKS_PER_RADIAN
        ours = radians_to_lerobot(angles, mode, *joint.ends(joint.closed_at), joint.inverted)
        np.testing.assert_allclose(ours, [normalised(each, mode, joint) for each in ticks], atol=1e-9)
        if name != "gripper":
            np.testing.assert_allclose(angles, (ticks - (joint.range_min + joint.range_max) / 2) * np.pi / 2048)


def test_contract_alone_is_for_conversion(tmp_path: Path) -> None:
    new = tmp_path / "new.yaml"
    imported = run_here("config", "import", FILES / "rosetta_base.yaml", new)
    assert f"ibrobot convert BAG --config {new}" in imported.stdout
    contract = load_contract(new).contract
    assert [each.key for each in contract.observations] == ["observation.state"] * 2 + ["observation.load"]
    assert contract.actions[0].joints == ("linear.x", "angular.z")


def test_name_of_the_robot_is_the_default_name_of_the_new_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_here("config", "import", FILES / "ib_robot_arm.yaml").returncode == 0
    assert (tmp_path / "bench_arm.yaml").is_file()
    assert "exists already" in run_here("config", "import", FILES / "ib_robot_arm.yaml").stderr
