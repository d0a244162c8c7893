"""Mistakes that a plugin's author makes are named when it is discovered, and what it offers is not used."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from ibrobot_testing import host_context

from ibrobot_core.config import load_config
from ibrobot_core.errors import ConfigError, ContractError, PluginError, TeleopError
from ibrobot_core.messages import MESSAGE_TYPES
from ibrobot_core.plugins import discover
from ibrobot_core.selection import Selection

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

HEAD = """
import attrs
from ibrobot_core.api import HardwareDescriptor, Teleop, TeleopDescriptor, SensorDescriptor, Options, hookimpl, option


@attrs.frozen
class Given(Options):
    gain: float = option(1.0, ge=0)


class Wave:
    pass
"""
YIELDS = """

@hookimpl
def ibrobot_teleop():
    yield TeleopDescriptor("wave", Wave, "waves", options=Given)
"""
OPTIONS = "option(1.0, ge=0)"
MISTAKES = {
    "empty type": ('"wave"', '""', "type '' is not a name: use letters, digits and _, e.g. my_arm"),
    "type with a blank": ('"wave"', '"my wave"', "type 'my wave' is not a name"),
    "type with an escape": ('"wave"', r'"wave\033[1m"', r"type 'wave\x1b[1m' is not a name"),
    "no make": ("Wave,", "None,", "make is None: give a class, or a function that makes the object"),
    "abstract class": ("Wave,", "Teleop,", "make is an abstract class: it lacks connect, disconnect, read"),
    "options of a plain class": ("@attrs.frozen", "", "options: <class 'fake_wave.Given'> is not an attrs class"),
    "options that derive from nothing": ("Given(Options)", "Given", "options: Given does not derive from Options"),
    "option with the name of a method": (
        "gain: float", "devices: float", "Given.devices hides a method of Options: rename it, with key='devices'",
    ),
    "options of no class": ("options=Given", "options=Given()", "must be a builtins.type[Any], not Given(gain="),
    "default out of range": (
        OPTIONS, "option(-1.0, ge=0)", "options: the default of Given.gain fails its own check: -1.0 is too small",
    ),
    "default of no choice": (OPTIONS, "option('x', choices=('a', 'b'))", "fails its own check: 'x' is not one of: a"),
    "sensor of the hook of devices": ("TeleopDescriptor(", "SensorDescriptor(", "expected a TeleopDescriptor, got "),
    "nothing yielded": ("    yield ", "    ", "it returned None: yield what it offers"),
    "returned, not yielded": ("    yield ", "    return ", "it returned TeleopDescriptor: yield what it offers"),
    "no marks": ("@hookimpl", "", "ibrobot_teleop is not marked with @hookimpl"),
    "no hooks": (YIELDS, "", "fake_wave has no hooks: functions that are marked with @hookimpl"),
}  # fmt: skip


def offer(site: Site, tmp_path: Path, source: str, name: str = "fake-wave") -> None:
    file = tmp_path / f"{name}.py"
    file.write_text(source)
    site.add(name, file)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_is_named_with_its_package(site: Site, tmp_path: Path, mistake: str) -> None:
    right, wrong, message = MISTAKES[mistake]
    source = HEAD + YIELDS
    assert right in source
    offer(site, tmp_path, source.replace(right, wrong))
    registry = discover(site.entry_points())

    (failure,) = registry.failures
    assert message in str(failure)
    assert str(failure).startswith("plugin 'fake_wave' (fake-wave) ")
    with pytest.raises(PluginError, match="fake-wave"):  # where it is asked for
        registry.find("teleop", "wave")


YIELD = 'TeleopDescriptor("wave", Wave, "waves", options=Given)'
SIBLINGS = {
    '"wave"': (
        *map(
            repr,
            (
                " ",
                "wave ",
                " wave",
                "wave\n",
                "\twave",
                "wave\x00",
                "wave\x1b[2J",
                "wave/..",
                "../wave",
                "-wave",
                ".wave",
                "_wave",
                "wave:1",
                "wave,2",
                "{wave}",
                "wave\u202eevaw",
                "\u200bwave",
                "wave*",
                "$wave",
            ),
        ),
        "None",
        "3",
        "True",
        "b'wave'",
        "['wave']",
        "('wave',)",
        "{}",
        "Wave",
    ),
    "Wave,": ("3,", "'fake_wave:Wave',", "[],", "{},", "Wave(),", "Options(),", "...,"),
    "options=Given": (
        "options=None",
        "options=3",
        "options='Given'",
        "options=dict",
        "options=int",
        "options=Wave",
        "options=[Given]",
        "options={'gain': 1.0}",
        "options=lambda: Given()",
        "options=Teleop",
        "options=attrs.make_class('G', ['gain'])",
    ),
    OPTIONS: (
        "option('one', ge=0)",
        "option(float('nan'), ge=0)",
        "option(-1e-9, ge=0)",
        "option(2.0, ge=0, le=1)",
        "option('b', choices=('a',))",
        "option('', choices=('a', 'b'))",
    ),
    f"yield {YIELD}": (
        "return 3",
        "return 'wave'",
        "return True",
        f"return {YIELD}",
        "yield None",
        "yield 3",
        "yield 'wave'",
        "yield Wave",
        "yield TeleopDescriptor",
        f"yield [{YIELD}]",
        f"yield (lambda: {YIELD})",
        "yield TeleopDescriptor('wave')",
        "yield TeleopDescriptor('wave', Wave, 'waves', optoins=Given)",
        "1 / 0; yield",
        "raise KeyError('wave')",
        "import no_such_library",
        "yield wave",
        "assert False",
    ),
    "@hookimpl\ndef ibrobot_teleop()": (
        "@hookimpl\ndef ibrobot_telop()",
        "@hookimpl\ndef ibrobot_teleop(robot)",
        "def ibrobot_teleop()",
        "@hookimpl\ndef teleop()",
        "@hookimpl()\ndef ibrobot_hardwares()",
        "@hookimpl\nasync def ibrobot_teleop()",
        "@hookimpl\nclass ibrobot_teleop",
    ),
}
"""What stands in a right plugin -> mistakes of an author in its place."""


@pytest.mark.parametrize(
    ("right", "wrong"), [(right, wrong) for right, mistakes in SIBLINGS.items() for wrong in mistakes], ids=ascii
)
def test_sibling_of_a_mistake_is_one_line_that_names_the_package(
    site: Site, tmp_path: Path, right: str, wrong: str
) -> None:
    source = HEAD + YIELDS
    assert right in source
    offer(site, tmp_path, source.replace(right, wrong))
    registry = discover(site.entry_points())
    lines = [str(failure) for failure in registry.failures]
    assert lines, "the mistake is accepted"
    for line in lines:
        assert line.startswith("plugin 'fake_wave' (fake-wave) ")
        assert line.isprintable(), ascii(line)
    with pytest.raises(PluginError, match="fake-wave"):
        registry.find("teleop", "wave")


MESSAGE = """
import attrs
from ibrobot_core.api import Header, Late, Message, MessageDescriptor, hookimpl


@attrs.frozen
class Touch(Message, ros_type="skin_msgs/msg/Touch", definition="std_msgs/Header header\\nfloat32 force\\n"):
    header: Header = Header()
    force: float = 0.0


@hookimpl
def ibrobot_messages():
    yield MessageDescriptor("skin_msgs/msg/Touch", Late("fake_skin:Touch"))
"""
WRONG_MESSAGES = {
    "name without a package": (
        '"skin_msgs/msg/Touch", Late',
        '"Touch", Late',
        "type 'Touch' is no name of a message",
    ),
    "class instead of its place": ('Late("fake_skin:Touch")', "Touch", "MessageDescriptor.message must be a Late, not"),
}


@pytest.mark.parametrize("mistake", WRONG_MESSAGES)
def test_wrong_message_type_is_named_with_its_package(site: Site, tmp_path: Path, mistake: str) -> None:
    right, wrong, reason = WRONG_MESSAGES[mistake]
    assert right in MESSAGE
    offer(site, tmp_path, MESSAGE.replace(right, wrong), "fake-skin")
    (failure,) = discover(site.entry_points()).failures
    assert str(failure).startswith("plugin 'fake_skin' (fake-skin) ")
    assert reason in str(failure)


def test_class_of_another_type_is_refused_where_it_is_needed(site: Site, tmp_path: Path) -> None:
    offer(
        site,
        tmp_path,
        MESSAGE.replace('Descriptor("skin_msgs/msg/Touch"', 'Descriptor("skin_msgs/msg/Push"'),
        "fake-skin",
    )
    with pytest.raises(PluginError, match=r"fake_skin:Touch is no message of type skin_msgs/msg/Push"):
        MESSAGE_TYPES["skin_msgs/msg/Push"]


def test_two_packages_that_define_one_message_type_are_named(site: Site, tmp_path: Path) -> None:
    offer(site, tmp_path, MESSAGE, "fake-skin")
    offer(site, tmp_path, MESSAGE, "other-skin")
    (failure,) = discover(site.entry_points()).failures
    assert "message type skin_msgs/msg/Touch is defined by fake_skin:Touch already" in str(failure)
    assert "(other-skin)" in str(failure)


def test_message_type_of_a_plugin_is_known_as_those_of_core_are(site: Site, tmp_path: Path) -> None:
    offer(site, tmp_path, MESSAGE, "fake-skin")
    assert "skin_msgs/msg/Touch" in MESSAGE_TYPES
    assert "skin_msgs/msg/Touch" in [*MESSAGE_TYPES]
    kind: Any = MESSAGE_TYPES["skin_msgs/msg/Touch"]
    touch = kind(force=0.5)
    assert Selection(touch.ros_type, ["force"])(touch) == 0.5
    with pytest.raises(ContractError, match=r"Touch has no field 'farce'.*did you mean 'force'"):
        Selection(touch.ros_type, ["farce"])
    with pytest.raises(ContractError, match="needs a select: paths to its numbers"):
        Selection(touch.ros_type)


def test_plugin_without_mistakes_is_used(site: Site, tmp_path: Path) -> None:
    offer(site, tmp_path, HEAD + YIELDS)
    registry = discover(site.entry_points())
    assert registry.failures == []
    assert registry.find("teleop", "wave").summary == "waves"


def test_types_of_two_packages_are_refused_where_they_are_used(site: Site, tmp_path: Path) -> None:
    for name in ("fake-one", "fake-two"):
        offer(site, tmp_path, HEAD + YIELDS, name)
    registry = discover(site.entry_points())
    assert str(registry.failures[0]).endswith("teleop type 'wave' is offered by fake-one already")
    with pytest.raises(PluginError, match="'wave' is offered by fake-one and fake-two: uninstall all but one of them"):
        registry.find("teleop", "wave")


def test_package_that_is_on_the_path_twice_is_one(site: Site, tmp_path: Path) -> None:
    offer(site, tmp_path, HEAD + YIELDS)
    registry = discover(site.entry_points() * 2)
    assert registry.find("teleop", "wave").summary == "waves"


def test_type_of_core_stays_that_of_core(site: Site, tmp_path: Path) -> None:
    source = HEAD.replace("HardwareDescriptor", "ExecutorDescriptor") + YIELDS.replace(
        "ibrobot_teleop", "ibrobot_executors"
    )
    offer(site, tmp_path, source.replace('TeleopDescriptor("wave"', 'ExecutorDescriptor("position"'))
    registry = discover(site.entry_points())
    assert str(registry.failures[0]).endswith("executor type 'position' is offered by ibrobot-core already")
    assert registry.entries["executor", "position"].package == "ibrobot-core"
    assert registry.find("executor", "position").summary != "waves"


def test_plugin_for_another_version_of_the_interface_says_what_to_update(site: Site, tmp_path: Path) -> None:
    offer(site, tmp_path, "raise RuntimeError('not imported')")
    entry = site.folder / "fake_wave-1.0.dist-info/entry_points.txt"
    entry.write_text(entry.read_text().replace("[ibrobot]", "[ibrobot.2]"))
    (failure,) = discover(site.entry_points()).failures
    assert str(failure) == (
        "plugin 'fake_wave' (fake-wave) failed to import: PluginError: it needs version 2 of the plugin interface; "
        "ibrobot-core has 1: update ibrobot-core"
    )


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ("None", "make of teleop type 'wave' returned None; expected Teleop"),
        ("Wave()", "make of teleop type 'wave' returned <fake_wave.Wave object at "),
    ],
)
def test_make_of_something_else_is_named(site: Site, tmp_path: Path, made: str, message: str) -> None:
    offer(site, tmp_path, HEAD + YIELDS.replace("Wave,", f"lambda options, ctx: {made},"))
    registry = discover(site.entry_points())
    with pytest.raises(PluginError, match=message):
        registry.create("teleop", "wave", None, None)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ("Wave(1)", "TypeError: Wave() takes no arguments (its traceback is in "),
        ("Teleop()", "TypeError: Can't instantiate abstract class Teleop without an implementation for "),
        (
            'Late("fake_wave:Wafe")()',
            "AttributeError: module 'fake_wave' has no attribute 'Wafe' (its traceback is in ",
        ),
        ("1 / 0", "ZeroDivisionError: division by zero (its traceback is in "),
        ("open('/nowhere/else')", "FileNotFoundError: "),
    ],
)
def test_bug_in_make_names_the_component_and_the_plugin(site: Site, tmp_path: Path, made: str, message: str) -> None:
    head = HEAD.replace("hookimpl,", "Late, hookimpl,")
    offer(site, tmp_path, head + YIELDS.replace("Wave,", f"lambda options, ctx: {made},"))
    registry = discover(site.entry_points())
    with pytest.raises(PluginError) as raised:
        registry.create("teleop", "wave", None, host_context(name="leader"))
    assert str(raised.value).startswith(f"leader: plugin 'fake_wave' failed in make of teleop type 'wave': {message}")


def test_error_that_make_means_is_not_changed(site: Site, tmp_path: Path) -> None:
    source = "from ibrobot_core.api import TeleopError\n\n\ndef refuse(options, ctx):\n    raise TeleopError('busy')\n"
    offer(site, tmp_path, HEAD + source + YIELDS.replace("Wave,", "refuse,"))
    registry = discover(site.entry_points())
    with pytest.raises(TeleopError, match=r"^busy$"):
        registry.create("teleop", "wave", None, host_context())


def test_option_that_hides_a_key_of_its_section_is_named(site: Site, tmp_path: Path) -> None:
    source = HEAD.replace("gain: float", "joints: float") + YIELDS.replace("TeleopDescriptor", "HardwareDescriptor")
    offer(site, tmp_path, source.replace("ibrobot_teleop", "ibrobot_hardware"))
    robot = tmp_path / "robot.yaml"
    robot.write_text(
        "robot: {name: r, joints: [{name: pan, lower: -1, upper: 1, max_velocity: 1, max_acceleration: 1}]}\n"
        "hardware: {arm: {type: wave, joints: [pan]}}\n"
    )
    with pytest.raises(ConfigError, match="the plugin calls an option 'joints', which is a key of every section of"):
        load_config(robot, registry=discover(site.entry_points()))
