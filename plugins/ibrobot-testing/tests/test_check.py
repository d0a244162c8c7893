"""`ibrobot plugins check` names what is wrong with a package, and what it could not check."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
from ibrobot_kit.check import CheckPlugin, examine
from ibrobot_kit.new import NewPlugin
from ibrobot_testing.site import Site, made_up_site

from ibrobot_core.api import Check, how_to_install
from ibrobot_core.app import RequestError, Unsuccessful, installed_plugins

PLUGIN = """
import attrs
from ibrobot_core.api import Late, TeleopDescriptor, Options, hookimpl, option


@attrs.frozen
class Given(Options):
    gain: float = option(1.0, ge=0, help="how fast")


@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("wave", Late("ibrobot_testing.fakes.host:FakeTeleop"), "waves", options=Given)
"""
REQUIRES = "ibrobot-core>=0.1,<0.2"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    with made_up_site(tmp_path / "site", tmp_path, monkeypatch) as site:
        yield site


def install(site: Site, plugin: str = PLUGIN, requires: str = REQUIRES) -> None:
    """Install a plugin, as from a wheel."""
    source = site.sources / "source.py"
    source.write_text(plugin)
    site.add("fake-wave", source)
    metadata = site.folder / "fake_wave-1.0.dist-info/METADATA"
    metadata.write_text(metadata.read_text() + (f"Requires-Dist: {requires}\n" if requires else ""))
    installed_plugins.cache_clear()


def checks() -> dict[str, Check]:
    return {check.name: check for check in examine("fake-wave", installed_plugins())}


def test_good_package_fails_nothing_and_says_what_was_not_run(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    install(site)
    command = CheckPlugin("fake-wave")
    done = command()
    assert [check.name for check in done if not check.ok] == ["tests"]
    command.show(done)
    assert capsys.readouterr().out.splitlines() == [
        "ok    discovery: teleop wave",
        "ok    versions: ibrobot-core<0.2,>=0.1; 0.1.0 is installed",
        "ok    weight: fake_wave imports nothing heavy",
        "ok    teleop wave: options have help",
        "ok    teleop wave: ibrobot_testing.fakes.host:FakeTeleop is there",
        f"note  tests: not run: wheels have no tests; install its source by {how_to_install('-e', 'FOLDER')}",
    ]


@pytest.mark.parametrize(
    ("old", "new", "name", "message"),
    [
        ('"wave"', '"my wave"', "discovery",
         "type 'my wave' is not a name: use letters, digits and _, e.g. my_arm; "
         "nothing, or not all, of what it offers is used"),
        ("import attrs\n", "import attrs, numpy\n", "weight",
         '; each ibrobot command imports that: import it in `make`, e.g. by Late("MODULE:NAME"), or under `if TYPE_CH'),
        ("import attrs\n", "import attrs\nimport sys\nif sys.argv[0] == '-c': raise OSError('no port')\n", "weight",
         "fake_wave cannot be imported alone: OSError: no port"),
        (', help="how fast"', "", "teleop wave",
         "options without help: gain; ibrobot plugins show and forms show it: write help=…"),
        (':FakeTeleop")', ':Nobody")', "teleop wave",
         "ibrobot_testing.fakes.host:Nobody cannot be imported: module 'ibrobot_testing.fakes.host' has no attribute"),
        (':FakeTeleop")', ':Nobody")', "teleop wave", "; correct the name"),
        ("ibrobot_testing.fakes.host:", "fake_wave.none:", "teleop wave", "; correct the name"),
        ("ibrobot_testing.fakes.host:FakeTeleop", "ibrobot_core.api:Teleop", "teleop wave",
         "Teleop lacks connect, disconnect, read; define these methods"),
        ('"waves"', '""', "teleop wave", "it has no summary; lists of plugins show it"),
        ("import attrs\n", "import attrs\nimport os, sys\nif sys.argv[0] == '-c': os._exit(3)\n", "weight",
         "fake_wave cannot be imported alone: it ended without a word"),
    ],
)  # fmt: skip
def test_mistake_fails_with_its_cause(site: Site, old: str, new: str, name: str, message: str) -> None:
    assert old in PLUGIN
    install(site, PLUGIN.replace(old, new))
    with pytest.raises(Unsuccessful) as failed:
        CheckPlugin("fake-wave")()
    wrong = [check for check in failed.value.result if check.matters and not check.ok]
    assert [check.name for check in wrong] == [name]
    assert message in f"{wrong[0].found}; {wrong[0].remedy}"


@pytest.mark.parametrize(
    ("requires", "is_light"),
    [
        (REQUIRES, False),
        (f"{REQUIRES}\nRequires-Dist: fake-base", True),
        (f"{REQUIRES}\nRequires-Dist: Fake_Base", True),
    ],
)
def test_what_a_required_plugin_imports_is_not_its_own_weight(site: Site, requires: str, *, is_light: bool) -> None:
    source = site.sources / "base.py"
    source.write_text("import numpy\n")
    site.add("fake-base", source)
    install(site, f"import fake_base\n{PLUGIN}", requires)
    assert checks()["weight"].ok is is_light


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("import numpy", ""),
        ("from ibrobot_core.api import JointReading", ", for JointReading"),
        ("import fake_base", ""),
    ],
)
def test_line_that_imports_a_heavy_package_is_named(site: Site, statement: str, told: str) -> None:
    source = site.sources / "base.py"
    source.write_text("import numpy\n")
    site.add("fake-base", source)
    install(site, PLUGIN.replace("import attrs\n", f"import attrs\n\n{statement}\nimport numpy\n"))
    file = Path(str(import_module("fake_wave").__file__))
    assert checks()["weight"].found == f"fake_wave imports numpy ({file}:4{told})"


def test_name_that_needs_a_heavy_package_is_right_in_a_module_with_many_names(site: Site) -> None:
    """Beyond 256 of them, an instruction has its name in two parts."""
    many = "".join(f"name_{number} = {number}\n" for number in range(300))
    install(site, many + "from ibrobot_core.api import JointReading\n" + PLUGIN)
    assert checks()["weight"].found.endswith(".py:301, for JointReading)")


def test_module_that_does_not_end_is_an_error(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["pytest"])  # xdist's own is "-c", as that of the import alone
    install(site, "import sys, time\nif sys.argv[0] == '-c': time.sleep(600)\n" + PLUGIN)
    monkeypatch.setattr("ibrobot_kit.check._IMPORT_S", 0.01)
    check = checks()["weight"]
    assert (check.ok, check.found) == (
        False, "fake_wave cannot be imported alone: it did not end within 0.01 s",
    )  # fmt: skip


def test_missing_dependency_of_an_implementation_is_named(site: Site) -> None:
    install(site, PLUGIN.replace("ibrobot_testing.fakes.host:", "fake_stick:"))
    (site.folder / "fake_stick.py").write_text("import no_such_library.sticks\n")
    wrong = [check for check in examine("fake-wave", installed_plugins()) if check.name == "teleop wave"][-1]
    assert wrong.found == "fake_stick:FakeTeleop cannot be imported: No module named 'no_such_library'"
    assert (wrong.ok, wrong.remedy) == (False, "add the package with no_such_library to dependencies in pyproject.toml")


@pytest.mark.parametrize(
    ("requires", "message", "remedy", "fails"),
    [
        ("", "it does not require ibrobot-core", 'add "ibrobot-core>=0.1,<0.2" to its dependencies', True),
        ("ibrobot-core>=9,<10", "ibrobot-core<10,>=9; 0.1.0 is installed",
         "install a version of ibrobot-core that it permits", True),
        ("ibrobot-core>=0.1", "ibrobot-core>=0.1 permits all later versions",
         "interfaces change between minor versions before 1.0: add an upper bound, e.g. <0.2", False),
    ],
)  # fmt: skip
def test_versions_that_do_not_fit_are_named(
    site: Site, requires: str, message: str, remedy: str, *, fails: bool
) -> None:
    install(site, requires=requires)
    check = checks()["versions"]
    assert (check.ok, check.matters, check.found, check.remedy) == (False, fails, message, remedy)


@pytest.mark.parametrize(
    "requires",
    [
        "ibrobot_core>=0.1,<0.2",
        "Ibrobot.Core>=0.1,<0.2",
        "ibrobot-core>=0.1\nRequires-Dist: ibrobot-core<0.2",
        "ibrobot-core>=0.1,<0.2\nRequires-Dist: ibrobot-core>=9; extra == 'next'",
        "ibrobot-core>=0.1,<0.2\nRequires-Dist: ibrobot-core>=9; python_version < '3'",
    ],
)
def test_versions_that_fit_are_found_however_they_are_written(site: Site, requires: str) -> None:
    install(site, requires=requires)
    assert [check.ok for check in examine("fake-wave", installed_plugins()) if check.name == "versions"] == [True]


def test_function_that_makes_the_object_is_listed_as_not_looked_at(site: Site) -> None:
    install(site, PLUGIN.replace("Late(", "lambda options, ctx: Late("))
    check = checks()["teleop wave"]
    assert (check.found, check.matters) == ("make is a function: what it makes was not looked at", False)


@pytest.mark.parametrize(("made", "found"), [("FakeTeleop", "is there"), ("Nobody", "cannot be imported")])
def test_place_that_a_function_uses_is_looked_at(site: Site, made: str, found: str) -> None:
    function = PLUGIN.replace('    yield TeleopDescriptor("wave", Late(', "    make = Late(")
    function = function.replace(':FakeTeleop"), "waves", options=Given)', f':{made}")')
    install(site, f'{function}    yield TeleopDescriptor("wave", lambda options, ctx: make(ctx), "waves")\n')
    every = [check.found for check in examine("fake-wave", installed_plugins()) if check.name == "teleop wave"]
    assert every[0] == "it has no options"
    assert f"ibrobot_testing.fakes.host:{made} {found}" in every[1]


def test_what_a_module_prints_does_not_disturb_the_check(site: Site) -> None:
    alone = (
        "import atexit, sys\nif sys.argv[0] == '-c': print('no line', end=''), atexit.register(print, 'loaded: bye')\n"
    )
    install(site, alone + PLUGIN)
    assert checks()["weight"].found == "fake_wave imports nothing heavy"


def test_class_that_makes_the_object_is_looked_at(site: Site) -> None:
    wave = "\n\nfrom ibrobot_core.api import Teleop\n\n\nclass Wave(Teleop):\n    read = connect = disconnect = print\n"
    install(site, PLUGIN.replace('Late("ibrobot_testing.fakes.host:FakeTeleop")', "Wave") + wave)
    every = [check for check in examine("fake-wave", installed_plugins()) if check.name == "teleop wave"]
    assert (every[-1].ok, every[-1].found) == (True, "fake_wave:Wave is there")


def as_source(site: Site, folder: Path) -> None:
    """Let the package be installed from a folder, as by `pip install -e`."""
    facts = {"url": folder.as_uri(), "dir_info": {"editable": True}}
    (site.folder / "fake_wave-1.0.dist-info/direct_url.json").write_text(json.dumps(facts))


def test_tests_of_the_source_are_run(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(site)
    folder = Path(NewPlugin("viewer", "odd_one", tmp_path / "a folder")()["folder"])
    monkeypatch.setenv("PYTHONPATH", str(folder))
    as_source(site, folder)
    assert checks()["tests"].ok
    implementation = folder / "ibrobot_odd_one/viewer.py"
    implementation.write_text(implementation.read_text().replace("return not self.person_closed", "return True"))
    check = checks()["tests"]
    assert not check.ok
    assert "1 failed" in check.found
    assert "FAILED tests/test_odd_one.py::TestOddOne::test_" in check.found
    assert check.remedy == f"cd {folder} && pytest"
    assert "not checked" not in checks()
    (folder / "tests/test_odd_one.py").write_text("def test_nothing(): pass\n")
    check = checks()["tests"]
    assert check.found.endswith("has no conformance suite")
    assert check.remedy == "subclass the suite of its kind, of ibrobot_testing"


def test_tests_that_do_not_end_are_an_error(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(site)
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/test_slow.py").write_text("import time\n\nclass TestSlow(Suite): pass\n\ntime.sleep(600)\n")
    monkeypatch.setattr("ibrobot_kit.check._TESTS_S", 0.01)
    as_source(site, tmp_path)
    check = checks()["tests"]
    assert (check.ok, check.found, check.remedy) == (False, "did not end within 0.01 s", f"cd {tmp_path} && pytest")


def test_checks_that_need_a_hook_are_listed(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(site)
    folder = Path(NewPlugin("policy", "odd_one", tmp_path)()["folder"])
    monkeypatch.setenv("PYTHONPATH", str(folder))
    as_source(site, folder)
    check = checks()["not checked"]
    assert (check.found, check.matters) == ("the suite overrides no another", False)
    assert check.remedy == "how-to/test-a-plugin says what each makes the device do"


@pytest.mark.parametrize(
    ("package", "message"),
    [
        ("nobody-has-this", "nobody-has-this is not installed in this environment"),
        ("attrs", "has no entry point in the group `ibrobot`, so it is not a plugin"),
        ("pytest", "in the group `ibrobot`, only in console_scripts, so it is not a plugin"),
    ],
)
def test_what_is_no_plugin_is_an_error(package: str, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        CheckPlugin(package)()


@pytest.mark.parametrize(
    ("type_", "place", "text"),
    [
        ("skin_msgs/msg/Touch", "fake_wave:Touch", "fake_wave:Touch is there"),
        ("sensor_msgs/msg/JointState", "fake_wave:JointState",
         "core has this type, so that yours is not used; give it a name of its own"),
        ("skin_msgs/msg/Push", "fake_wave:Touch",
         "no message of type skin_msgs/msg/Push: <class 'fake_wave.Touch'>; name a class that is derived from Message"),
        ("skin_msgs/msg/Touch", "fake_wave:Tuch", "fake_wave:Tuch: module 'fake_wave' has no attribute 'Tuch'"),
    ],
)  # fmt: skip
def test_message_types_are_checked(site: Site, type_: str, place: str, text: str) -> None:
    messages = f'''

from ibrobot_core.api import Message, MessageDescriptor


class Touch(Message, ros_type="skin_msgs/msg/Touch"):
    pass


class JointState(Message, ros_type="sensor_msgs/msg/JointState"):
    pass


@hookimpl
def ibrobot_messages():
    yield MessageDescriptor("{type_}", Late("{place}"))
'''
    install(site, PLUGIN + messages)
    check = checks()[f"message {type_}"]
    assert text in f"{check.found}; {check.remedy}"
    assert check.ok == text.endswith("is there")
