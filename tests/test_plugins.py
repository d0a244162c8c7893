"""Discovery: good plugins work beside broken ones, and every failure is reported where it matters."""

from __future__ import annotations

import importlib
import logging
import subprocess
import sys
from typing import TYPE_CHECKING

import numpy as np
import pytest
from ibrobot_testing import host_context

from ibrobot_core.descriptors import Options, ReaderDescriptor
from ibrobot_core.errors import ContractError, NotSupported, PluginError, RecorderError
from ibrobot_core.messages import CompressedImage, Header
from ibrobot_core.plugins import KINDS, Registry, discover

if TYPE_CHECKING:
    from pathlib import Path

    from ibrobot_testing.site import Site


@pytest.fixture
def registry(site: Site) -> Registry:
    site.add("fake-exits", "exits_at_import.py")
    site.add("fake-good", "good.py")
    site.add("fake-import", "fails_at_import.py")
    site.add("fake-later", "raises_later.py")
    site.add("fake-misspelt", "misspelt_hook.py")
    site.add("fake-nothing", "no_descriptor.py")
    site.add("fake-raising", "raising_hook.py")
    site.add("fake-twin", "twin.py")
    site.add("fake-wrong", "wrong_argument.py")
    return discover(site.entry_points())


def test_the_first_decoder_that_knows_a_picture_decodes_it(site: Site) -> None:
    site.add("fake-decoders", "decoders.py")
    registry = discover(site.entry_points())

    def picture(size: int) -> CompressedImage:
        return CompressedImage(Header(), "odd", np.zeros(size, np.uint8))

    found: list[object] = [registry.decode(picture(size)) for size in (0, 1)]
    assert found == ["nothing", "something"]
    with pytest.raises(ContractError, match=r"no installed plugin decodes a 'odd' picture; .* are: any, empty, short"):
        registry.decode(picture(9))


def test_a_good_plugin_works_beside_broken_ones(registry: Registry) -> None:
    entry = registry.entries["hardware", "good_arm"]

    assert (entry.package, entry.version, entry.plugin) == ("fake-good", "1.0", "fake_good")
    assert entry.descriptor.summary == "an arm that works"
    with pytest.raises(PluginError, match="'good_arm' is offered by fake-good and fake-twin: uninstall all but one of"):
        registry.find("hardware", "good_arm")
    assert [config.name for config in registry.configs] == ["good", "other"]
    assert registry.types("executor") == ["position"]


def test_every_failure_is_reported_with_its_cause(registry: Registry) -> None:
    assert [str(failure) for failure in registry.failures] == [
        "plugin 'fake_exits' (fake-exits) failed to import: SystemExit: 3",
        "plugin 'fake_import' (fake-import) failed to import: ImportError: no library",
        "plugin 'fake_misspelt' (fake-misspelt) has a wrong hook: "
        "ValueError: unknown hook 'ibrobot_hardwear', did you mean 'ibrobot_hardware'?",
        "plugin 'fake_nothing' (fake-nothing) failed in ibrobot_policies: "
        "TypeError: expected a PolicyDescriptor, got 'act'",
        "plugin 'fake_raising' (fake-raising) failed in ibrobot_sensors: RuntimeError: no driver",
        "plugin 'fake_twin' (fake-twin) failed in ibrobot_hardware: "
        "hardware type 'good_arm' is offered by fake-good already",
        "plugin 'fake_wrong' (fake-wrong) has a wrong hook: "
        "Plugin 'fake_wrong' for hook 'ibrobot_mode_changed': "
        "Argument(s) {'moed'} are declared in the hookimpl but can not be found in the hookspec",
    ]


def test_two_commands_of_one_name_are_a_failure_of_the_later_plugin(site: Site) -> None:
    site.add("fake-first", "two_commands.py")
    site.add("fake-second", "two_commands.py")
    registry = discover(site.entry_points())

    assert registry.commands["juggle"].summary == "juggles, as fake_first does"
    assert registry.command_packages["juggle"] == "fake-first"
    assert registry.command_packages["doctor"] == "ibrobot-core"
    assert [str(failure) for failure in registry.failures] == [
        "plugin 'fake_first' (fake-first) failed in ibrobot_commands: "
        "ibrobot doctor is offered by ibrobot-core already",
        "plugin 'fake_second' (fake-second) failed in ibrobot_commands: "
        "ibrobot doctor is offered by ibrobot-core already",
        "plugin 'fake_second' (fake-second) failed in ibrobot_commands: "
        "ibrobot juggle is offered by fake-first already",
    ]
    assert f"plugin fake_second: {registry.failures[2]}\n" in _ibrobot("doctor").stdout
    with pytest.raises(PluginError, match="ibrobot juggle is offered by fake-first and fake-second: uninstall all but"):
        registry.command("juggle")
    assert registry.command("doctor").summary != "juggles, as fake_first does"
    used = _ibrobot("juggle")
    assert (used.returncode, used.stderr.count("is offered by fake-first and fake-second: uninstall all but")) == (2, 1)
    assert _ibrobot("--help").returncode == 0
    assert _ibrobot("doctor", "--help").returncode == 0


def test_a_plugin_defines_a_kind_that_others_offer(site: Site) -> None:
    site.add("fake-aaa", "offers_judges.py")  # discovered before the kind is known
    site.add("fake-defining", "defines_a_kind.py")
    registry = discover(site.entry_points())

    assert registry.failures == []
    assert registry.find("judge", "strict").summary == "never pleased"
    assert {*registry.all_kinds} - {*KINDS} == {"judge"}
    with pytest.raises(PluginError, match="unknown judge type 'strct', did you mean 'strict'"):
        registry.find("judge", "strct")


def test_an_optional_hook_needs_no_kind(site: Site) -> None:
    site.add("fake-aaa", "offers_judges.py")
    registry = discover(site.entry_points())

    assert registry.failures == []
    assert registry.types("hardware") == ["plain_arm"]


def test_two_definitions_of_a_kind_and_wrong_offers_are_failures(site: Site) -> None:
    for name in ("fake-defining", "fake-other"):
        site.add(name, "defines_a_kind.py")
    site.add("fake-wrong", "misspelt_kind.py")
    site.add("fake-zzz", "offers_judges.py")
    vars(importlib.import_module("fake_zzz"))["ibrobot_judges"].__code__ = (lambda: iter(["strict"])).__code__
    registry = discover(site.entry_points())

    assert [str(failure) for failure in registry.failures] == [
        "plugin 'fake_other' (fake-other) failed in ibrobot_kinds: kind 'judge' is defined by another package already",
        "plugin 'fake_wrong' (fake-wrong) has a wrong hook: "
        "ValueError: unknown hook 'ibrobot_jugdes', did you mean 'ibrobot_judges'?",
        "plugin 'fake_zzz' (fake-zzz) failed in ibrobot_judges: TypeError: expected a JudgeDescriptor, got 'strict'",
    ]


def test_core_without_its_entry_point_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_core.plugins.entry_points", lambda: [])
    with pytest.raises(PluginError, match="the installed ibrobot-core has no plugin of its own: install it again"):
        discover([])


def test_a_missing_type_names_the_nearest_and_what_is_broken(registry: Registry) -> None:
    with pytest.raises(PluginError, match=r"unknown hardware type 'god_arm', did you mean 'good_arm'\?; plugin 'fake_"):
        registry.find("hardware", "god_arm")


def test_a_known_type_of_a_broken_plugin_names_that_plugin(site: Site) -> None:
    site.add("ibrobot-plugin-keyboard", "fails_at_import.py")

    with pytest.raises(PluginError) as result:
        discover(site.entry_points()).find("teleop", "keyboard")

    assert str(result.value) == (
        "teleop type 'keyboard' is not available: plugin 'ibrobot_plugin_keyboard' (ibrobot-plugin-keyboard) "
        "failed to import: ImportError: no library"
    )


def test_a_known_type_that_is_not_installed_says_what_to_install() -> None:
    with pytest.raises(PluginError, match=r"^teleop type 'keyboard' needs .*: pip install ibrobot-plugin-keyboard$"):
        discover([]).find("teleop", "keyboard")


def test_default_type_is_the_one_whose_descriptor_says_so(site: Site) -> None:
    site.add("disk-a", "default_recorder.py")
    assert discover(site.entry_points()).default("recorder") == "disk_a"


def test_missing_default_type_names_the_package_to_install() -> None:
    with pytest.raises(PluginError, match=r"no recorder is named, .* has a default: pip install ibrobot-plugin-mcap"):
        Registry().default("recorder")


def test_two_default_types_are_an_error_that_names_both(site: Site) -> None:
    site.add("disk-a", "default_recorder.py")
    site.add("disk-b", "default_recorder.py")
    with pytest.raises(PluginError, match=r"name the type of the recorder: .* disk_a \(disk-a\), disk_b \(disk-b\)"):
        discover(site.entry_points()).default("recorder")


def test_a_raising_doctor_check_is_a_failed_check(registry: Registry) -> None:
    checks = {check.name: check for check in registry.doctor()}

    assert checks["good arm"].ok
    assert not checks["plugin fake_later"].ok
    assert checks["plugin fake_later"].found == "its doctor check failed: OSError: no bus"


def test_events_reach_all_though_one_raises(registry: Registry, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.ERROR):
        registry.emit("ibrobot_mode_changed", robot="r", mode="teleop", previous="idle", stamp_ns=1)

    assert sys.modules["fake_good"].events == ["teleop"]
    assert caplog.messages == ["plugin 'fake_later' failed in ibrobot_mode_changed: ValueError: not now"]


def test_transport_local_is_the_word_for_none() -> None:
    with pytest.raises(NotSupported, match="transport local connects to nothing"):
        discover([]).find("transport", "local").make(Options(), host_context())


def test_every_kind_has_a_hook() -> None:
    from ibrobot_core import hookspecs

    assert all(hasattr(hookspecs, hook) for hook in KINDS.values())


def _ibrobot(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_the_command_shows_the_failures_and_still_works(registry: Registry) -> None:
    shown = _ibrobot("doctor")

    assert (shown.returncode, shown.stderr) == (1, "")
    for failure in registry.failures:
        assert f"FAIL  plugin {failure.plugin}: {failure}\n" in shown.stdout
    assert "good" in shown.stdout


def test_config_check_names_the_broken_plugin(registry: Registry, site: Site) -> None:
    config = site.folder / "robot.yaml"
    config.write_text("hardware: {type: libarm}\n")

    result = _ibrobot("config", "check", str(config))

    assert result.returncode == 2
    assert f"{config}:1: hardware.type: unknown hardware type 'libarm'" in result.stderr
    assert "plugin 'fake_import' (fake-import) failed to import: ImportError: no library" in result.stderr


def test_the_listing_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "sys.argv = ['ibrobot', 'plugins']\n"
        "from ibrobot_core.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print('heavy:', [name for name in ('torch', 'cv2', 'mujoco', 'mink', 'scipy') if name in sys.modules])\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)

    assert ran.stdout.splitlines()[-1] == "heavy: []"


def test_single_episode_has_no_number(tmp_path: Path) -> None:
    (tmp_path / "log.csv").touch()
    reader = ReaderDescriptor("log", "a log", reads=lambda path: True, make=lambda address: pytest.fail("it was read"))
    with pytest.raises(RecorderError, match=r"log.csv:3: .*log.csv is a single episode; leave :3 out"):
        Registry(readers=[reader]).open_episode(tmp_path / "log.csv:3")
