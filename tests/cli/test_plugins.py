"""`ibrobot plugins`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.cli.conftest import Ran

Ibrobot = Callable[..., "Ran"]


def test_the_table_has_a_row_for_every_type(ibrobot: Ibrobot, robot: Path) -> None:
    ran = ibrobot("plugins")

    rows = [line.rstrip().split(maxsplit=4) for line in ran.out.splitlines()]
    assert ran.code == 0
    assert rows[0] == ["kind", "type", "package", "version", "summary"]
    assert ["hardware", "fake_arm", "fake-arm", "1.0", "an arm of thin air"] in [
        [c.strip() for c in row] for row in rows
    ]
    assert [row[:3] for row in rows if row[1] == "position"] == [["executor", "position", "ibrobot-core"]]


def test_as_json_with_what_is_broken(ibrobot: Ibrobot, robot: Path, site: Site) -> None:
    site.add("fake-broken", "fails_at_import.py")

    listed = json.loads(ibrobot("plugins", "--json").out)

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


def test_show_prints_the_options_of_every_kind_of_that_name(ibrobot: Ibrobot, robot: Path) -> None:
    lines = [" ".join(line.split()) for line in ibrobot("plugins", "show", "fake_arm").out.splitlines()]

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


def test_show_as_json(ibrobot: Ibrobot, robot: Path) -> None:
    hardware, sensor = json.loads(ibrobot("plugins", "show", "fake_arm", "--json").out)

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


def test_show_of_an_unknown_type(ibrobot: Ibrobot, robot: Path) -> None:
    ran = ibrobot("plugins", "show", "fake_amr")

    assert (ran.code, ran.err) == (2, "error: unknown type 'fake_amr', did you mean 'fake_arm'?\n")
