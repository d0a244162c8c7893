"""The environment of the node."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from ibrobot_ros.installation import Interpreter, environment
from ibrobot_ros.options import RosInstallation

SETTINGS = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS")


@pytest.fixture(autouse=True)
def _bare(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in SETTINGS:
        monkeypatch.delenv(name, raising=False)


def test_shared_memory_of_fast_dds_has_room_for_images():
    found = environment(RosInstallation(), Interpreter(("python",), ""))
    assert found[SETTINGS[0]] == found[SETTINGS[1]]
    sizes = ElementTree.parse(Path(found[SETTINGS[0]])).iter("{http://www.eprosima.com}segment_size")
    assert [int(size.text or "") for size in sizes] == [16 << 20]


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_of_the_user_are_left_alone(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(name, "mine")
    found = environment(RosInstallation(), Interpreter(("python",), ""))
    assert {each: found[each] for each in SETTINGS if each in found} == {name: "mine"}
