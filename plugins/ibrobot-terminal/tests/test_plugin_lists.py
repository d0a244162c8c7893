"""`ibrobot plugins`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
from command_line import run_here

if TYPE_CHECKING:
    from ibrobot_testing.site import Site


@pytest.fixture(autouse=True)
def arm(site: Site) -> None:
    site.add("fake-arm", "cli_arm.py")


def test_the_table_has_a_row_for_every_type() -> None:
    ran = run_here("plugins")

    rows = [line.rstrip().split(maxsplit=4) for line in ran.stdout.splitlines()]
    assert ran.returncode == 0
    assert rows[0] == ["kind", "type", "package", "version", "summary"]
    assert ["hardware", "fake_arm", "fake-arm", "1.0", "an arm of thin air"] in [
        [c.strip() for c in row] for row in rows
    ]
    assert [row[:3] for row in rows if row[1] == "position"] == [["executor", "position", "ibrobot-core"]]


def test_as_json_with_what_is_broken(site: Site) -> None:
    site.add("fake-broken", "fails_at_import.py")

    listed = json.loads(run_here("plugins", "--json").stdout)

    assert {
        "kind": "sensor",
        "type": "fake_arm",
        "package": "fake-arm",
        "version": "1.0",
        "summary": "the camera in its hand",
        "missing": None,
    } in listed["plugins"]
    assert {
        "plugin": "fake_broken",
        "package": "fake-broken",
        "stage": "import",
        "reason": "ImportError: no library",
    } in listed["broken"]


def test_show_prints_the_options_of_every_kind_of_that_name() -> None:
    lines = [" ".join(line.split()) for line in run_here("plugins", "show", "fake_arm").stdout.splitlines()]

    assert lines == [
        "hardware type fake_arm (fake-arm 1.0): an arm of thin air",
        "name type unit default allowed help",
        "port str (required) serial port",
        "max_speed float rad/s 3.0 > 0, ≤ 6.5 speed limit of the servos",
        "mode str soft soft, hard how it holds",
        "servos tuple[Servo, ...] [] what differs from the default",
        "offset float | None rad null of the base",
        "sensor type fake_arm (fake-arm 1.0): the camera in its hand",
        "no options",
    ]


def test_show_as_json() -> None:
    hardware, sensor = json.loads(run_here("plugins", "show", "fake_arm", "--json").stdout)

    assert hardware["options"][1] == {
        "name": "max_speed",
        "type": "float",
        "unit": "rad/s",
        "required": False,
        "default": 3.0,
        "allowed": "> 0, ≤ 6.5",
        "secret": False,
        "help": "speed limit of the servos",
    }
    assert sensor["options"] == []


def test_show_of_an_unknown_type() -> None:
    ran = run_here("plugins", "show", "fake_amr")

    assert (ran.returncode, ran.stderr) == (2, "error: unknown type 'fake_amr', did you mean 'fake_arm'?\n")


def test_plugins_names_what_a_type_lacks(site: Site) -> None:
    site.add("fake-depth", "lacking_sensors.py")
    lacking = "lacking: sensor depth: libdepth.so.1 is not there; sudo apt-get install libdepth1 libusb-1.0-0"

    assert lacking in run_here("plugins").stdout.splitlines()
    assert lacking.replace("sensor depth: ", "") in run_here("plugins", "show", "depth").stdout.splitlines()
    rows = {row["type"]: row["missing"] for row in json.loads(run_here("plugins", "--json").stdout)["plugins"]}
    assert rows["depth"] == {
        "what": "libdepth.so.1 is not there",
        "apt": ["libdepth1", "libusb-1.0-0"],
        "remedy": "sudo apt-get install libdepth1 libusb-1.0-0",
    }
    assert rows["sound"] is None


def test_options_that_two_kinds_share_are_printed_once(site: Site) -> None:
    site.add("fake-twin", "twin_options.py")

    lines = [" ".join(line.split()) for line in run_here("plugins", "show", "twin").stdout.splitlines()]

    assert lines == [
        "sensor type twin (fake-twin 1.0): a camera",
        "name type unit default allowed help",
        "port str (required) serial port",
        "teleop type twin (fake-twin 1.0): a leader",
        "its options are those of sensor type twin",
    ]
    sensor, teleop = json.loads(run_here("plugins", "show", "twin", "--json").stdout)
    assert sensor["options"] == teleop["options"] != []
