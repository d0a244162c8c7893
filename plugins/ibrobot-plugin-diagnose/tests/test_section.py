"""The section `preflight`: before anything moves, a run compares its rig with a reference."""

from __future__ import annotations

import json
from typing import override

import attrs
import pytest
from command_line import run_here
from ibrobot_diagnose import ibrobot_sections
from ibrobot_diagnose.options import PreflightSection
from ibrobot_diagnose.section import RigCheck, compares, reference_for
from ibrobot_testing import SectionSuite, check_descriptor, make_session

from ibrobot_core.app import Component, Session, find_config, installed_plugins, load_config

_REGISTRY = installed_plugins()
_RENDERS = ("sensor", "mujoco") in _REGISTRY.entries and _REGISTRY.missing("sensor", "mujoco") is None
needs_simulation = pytest.mark.skipif(not _RENDERS, reason="needs ibrobot-plugin-mujoco, and OpenGL")


class TestRigCheck(SectionSuite):
    @override
    def component(self, session: Session) -> Component:
        return RigCheck(PreflightSection(), session)


def test_descriptor_is_complete():
    (descriptor,) = ibrobot_sections()
    check_descriptor(descriptor, PreflightSection(action="refuse"))
    component = descriptor.make(PreflightSection(action="off"), make_session())
    assert (component.name, component.summary) == ("preflight", "off")


@pytest.mark.parametrize("action", ["warn", "refuse"])
def test_section_without_a_reference_warns_that_nothing_is_compared(action, caplog):
    RigCheck(PreflightSection(action=action), make_session()).start()
    (record,) = caplog.records
    assert record.getMessage().startswith("preflight: there is no reference, so the rig is not compared; take one")
    caplog.clear()
    RigCheck(PreflightSection(action="off"), make_session()).start()
    RigCheck(None, make_session()).start()
    assert not caplog.records


RECORDED = ("recording={type: mcap, root: episodes}",)


@pytest.fixture
def config():
    return load_config(find_config("so101", installed_plugins()), overrides=RECORDED)


@needs_simulation
def test_hardware_is_compared_if_its_dataset_or_checkpoint_has_a_reference(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (reference_for(config), compares(config)) == (None, False)
    folder = config.recording.folder
    folder.mkdir(parents=True)
    (folder / "rig.json").touch()
    assert (reference_for(config), compares(config)) == (folder / "rig.json", True)
    simulated = load_config(find_config("so101", installed_plugins()), overrides=RECORDED, sim=True)
    assert (reference_for(simulated), compares(simulated)) == (folder / "rig.json", False)
    checkpoint = tmp_path / "checkpoint"
    checkpoint.mkdir()
    models = {"scripted_pick": {"type": "scripted_pick", "path": str(checkpoint)}}
    policy = attrs.evolve(
        config, recording=None, default_control_mode="model_inference", document={**config.document, "models": models}
    )
    assert reference_for(policy) is None
    (checkpoint / "reference.json").touch()
    assert reference_for(policy) == checkpoint / "reference.json"


FEW = [
    part
    for camera in ("top", "wrist")
    for each in ("fps=10", "width=320", "height=240")
    for part in ("--set", f"peripherals.{camera}.{each}")
]
"""A twelfth of the pixels, which take most of the time."""


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    file = tmp_path_factory.mktemp("rig") / "rig.json"
    assert run_here("preflight", "so101", "--sim", "--lockstep", "--seconds", 0.5, "--take", file, *FEW).returncode == 0
    return file


MOVED = ("--set", "simulation.scene={type: pick_cube, camera_turn: [0.02, 0.02]}")


def launch(section, *arguments):
    options = ("--sim", "--headless", "--duration", 0.1, "--set", f"preflight={json.dumps(section)}", *arguments)
    return run_here("launch", "so101", *options, *FEW)


@needs_simulation
@pytest.mark.integration
def test_run_of_a_rig_that_differs_is_refused_or_warned_of(reference):
    told = {"against": str(reference), "seconds": 0.5}
    refused = launch({**told, "action": "refuse"}, *MOVED, "--lockstep")
    assert refused.returncode == 1
    assert "error: preflight: The camera top has moved" in refused.stderr
    assert "Put the camera back" in refused.stderr
    warned = launch(told, *MOVED, "--lockstep")
    assert warned.returncode == 0
    assert "W preflight: FAIL  camera_moved: The camera top has moved" in warned.stderr
    off = launch({**told, "action": "off"}, *MOVED, "--lockstep")
    assert (off.returncode, "camera_moved" in off.stderr) == (0, False)


@needs_simulation
@pytest.mark.integration
def test_run_of_a_rig_that_is_as_it_was_begins(reference):
    """In real time; the others step."""
    done = launch({"against": str(reference), "action": "refuse", "seconds": 0.5})
    assert done.returncode == 0, done.stderr
    assert "I preflight: so101 is as in the reference" in done.stderr


@needs_simulation
@pytest.mark.integration
def test_first_recording_takes_the_reference(tmp_path):
    section = ("--set", "preflight={seconds: 0.5}")
    options = ("--sim", "--headless", "--auto", "--duration", 0.1, "--root", tmp_path, *section, *FEW)
    first = run_here("record", "so101", *options, "--lockstep")
    assert f"took the reference {tmp_path / 'default' / 'rig.json'}" in first.stderr
    second = run_here("record", "so101", *options, *MOVED, "--lockstep")
    assert "W preflight: FAIL  camera_moved" in second.stderr
    again = run_here("preflight", "so101", "--sim", "--lockstep", "--against", tmp_path / "default", "--json", *FEW)
    assert json.loads(again.stdout)["verdict"] == "ok"


@needs_simulation
@pytest.mark.integration
def test_reference_that_is_missing_is_named(tmp_path):
    done = launch({"against": str(tmp_path / "nowhere.json")}, "--lockstep")
    assert done.returncode == 1
    assert "nowhere.json: there is no such reference, dataset or checkpoint" in done.stderr
