"""Whatever a plugin does at import or in a hook, commands that do not use it work, and name it."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from ibrobot_core import hookspecs
from ibrobot_core.descriptors import SectionDescriptor
from ibrobot_core.errors import PluginError, RecorderError
from ibrobot_core.messages import CompressedImage, Header
from ibrobot_core.plugins import KINDS, discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

REGISTERING = sorted(
    name
    for name, hook in vars(hookspecs).items()
    if name.startswith("ibrobot_") and "Iterable" in str(hook.__annotations__)
)
RAISED = ("exception", "base", "interrupt", "exit", "generator_exit", "unprintable")
NAMELESS = (
    "hardware",
    "sensors",
    "readers",
    "decoders",
    "features",
    "configs",
    "commands",
    "doctor",
)
DEEDS = (*RAISED, "number", "none", "text", "kind", "returned")
BAD = (
    *(f"bad__import__{deed}" for deed in RAISED),
    *(f"bad__{hook}__{deed}" for hook in REGISTERING for deed in DEEDS),
    *(f"bad__{hook}__other" for hook in REGISTERING if hook != "ibrobot_sensors"),
    *(f"bad__ibrobot_{hook}__nameless" for hook in NAMELESS),
)
"""Plugins that each do one wrong thing."""
OF_DOCTOR = tuple(name for name in BAD if "ibrobot_doctor" in name)
"""Their hook is not called at discovery."""


@pytest.fixture
def bad(site: Site) -> Site:
    for name in BAD:
        site.add(name, "misbehaving.py")
    return site


def _ibrobot(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from ibrobot_core.cli.command import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)


def test_each_is_a_failure_with_its_package_and_its_hook(bad: Site) -> None:
    failures = discover(bad.entry_points()).failures

    assert len(BAD) == 265
    assert {failure.package: failure.stage for failure in failures} == {
        name: name.split("__")[1] for name in BAD if name not in OF_DOCTOR
    }


@pytest.mark.integration
def test_commands_that_use_none_of_them_work(bad: Site) -> None:
    listed = _ibrobot("plugins", "--json")
    assert listed.returncode == 0, listed.stderr
    assert {each["package"] for each in json.loads(listed.stdout)["broken"]} == {*BAD} - {*OF_DOCTOR}

    for arguments in (("config", "check", "so101"), ("launch", "so101", "--sim", "--dry-run")):
        ran = _ibrobot(*arguments)
        assert (ran.returncode, ran.stderr) == (0, ""), arguments

    examined = _ibrobot("doctor", "--json")
    found = {check["name"] for check in json.loads(examined.stdout) if not check["ok"]}
    assert {f"plugin {name}" for name in BAD} <= found


@pytest.mark.parametrize("deed", RAISED)
def test_an_event_reaches_others_whatever_one_raises(site: Site, deed: str, caplog: pytest.LogCaptureFixture) -> None:
    site.add(f"bad__ibrobot_mode_changed__{deed}", "misbehaving.py")
    site.add("fake-good", "good.py")
    with caplog.at_level(logging.ERROR):
        discover(site.entry_points()).emit(
            "ibrobot_mode_changed", robot="r", mode="teleop", previous="idle", stamp_ns=1
        )

    assert sys.modules["fake_good"].events == ["teleop"]
    assert f"plugin 'bad__ibrobot_mode_changed__{deed}' failed in ibrobot_mode_changed: " in caplog.text


@pytest.mark.integration
def test_a_question_about_any_robot_or_file_that_raises_is_answered_by_others(
    site: Site, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    site.add("fake-odd", "raising_questions.py")
    registry = discover(site.entry_points())
    with caplog.at_level(logging.ERROR), pytest.raises(RecorderError, match="not an episode of a known format"):
        registry.open_episode(tmp_path)
    assert "plugin 'fake_odd' failed in reads of ibrobot_readers: SystemExit: not today" in caplog.messages

    for arguments in (("config", "check", "so101"), ("launch", "so101", "--sim", "--dry-run")):
        ran = _ibrobot(*arguments)
        assert ran.returncode == 0, ran.stderr
        assert "plugin 'fake_odd' failed in without_section of ibrobot_sections: SystemExit: not today" in ran.stderr
        assert "plugin 'fake_odd' failed in takes of ibrobot_commands: SystemExit: not today" in ran.stderr


@pytest.mark.parametrize(
    "error",
    [SystemExit("not today"), ImportError("not today"), OSError("not today"), GeneratorExit("not today")],
    ids=repr,
)
@pytest.mark.parametrize("asked", ["make of ibrobot_decoders", "check_config of ibrobot_sections"])
def test_what_a_plugin_raises_where_it_is_needed_names_it(site: Site, error: BaseException, asked: str) -> None:
    site.add("fake-checks", "raising_checks.py")
    registry = discover(site.entry_points())
    vars(sys.modules["fake_checks"])["RAISED"] = error
    section = registry.find("section", "odd")
    assert isinstance(section, SectionDescriptor)
    picture = CompressedImage(Header(0), "odd", np.zeros(1, np.uint8))
    nothing: Any = None
    ask: Any = partial(registry.decode, picture) if "make" in asked else partial(section.check_config, nothing)
    with pytest.raises(PluginError) as raised:
        ask()
    assert str(raised.value) == f"plugin 'fake_checks' failed in {asked}: {type(error).__name__}: not today"


def test_every_kind_is_among_the_hooks_tried() -> None:
    assert {*KINDS.values()} < {*REGISTERING}
