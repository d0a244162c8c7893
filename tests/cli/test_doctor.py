"""`ibrobot doctor`."""

from __future__ import annotations

import errno
import json
import os
import resource
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING

import pytest

from ibrobot_core.cli import doctor
from ibrobot_core.control import realtime
from ibrobot_core.control.realtime import PERMIT
from ibrobot_core.plugins import discover

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

    from tests.cli.conftest import Ran

Ibrobot = Callable[..., "Ran"]


def test_a_failing_check_of_a_plugin_is_reported_with_its_remedy(ibrobot: Ibrobot, site: Site) -> None:
    site.add("fake-gl", "failing_check.py")

    ran = ibrobot("doctor")

    assert ran.code == 1
    assert "FAIL  GL: no context\n      apt install libegl1\n" in ran.out
    assert "ok    python: " in ran.out


def test_what_an_installed_type_lacks_is_noted_with_its_remedy(ibrobot: Ibrobot, site: Site) -> None:
    site.add("fake-depth", "lacking_sensors.py")

    ran = ibrobot("doctor")

    assert (
        "note  sensor depth, sensor far_depth: libdepth.so.1 is not there\n"
        "      sudo apt-get install libdepth1 libusb-1.0-0\n" in ran.out
    ), "once for all types that lack it"
    assert (
        "note  sensor odd: its check failed: ZeroDivisionError: one over nothing\n      report it to fake-depth"
        in ran.out
    )
    assert "sensor sound" not in ran.out


def test_as_json(ibrobot: Ibrobot, site: Site) -> None:
    site.add("fake-broken", "fails_at_import.py")

    found = {check["name"]: check for check in json.loads(ibrobot("doctor", "--json").out)}

    assert found["plugin fake_broken"] == {
        "name": "plugin fake_broken",
        "ok": False,
        "found": "plugin 'fake_broken' (fake-broken) failed to import: ImportError: no library",
        "remedy": "repair or uninstall the package fake-broken",
        "matters": True,
    }
    assert not found["real-time priority"]["matters"]


def test_a_sound_machine_passes(ibrobot: Ibrobot, site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(doctor, "examine", lambda registry: [doctor.memory_lock()])

    assert ibrobot("doctor").code == 0


def test_what_is_only_worth_knowing_fails_nothing(ibrobot: Ibrobot, monkeypatch: pytest.MonkeyPatch) -> None:
    _as_user(monkeypatch, rtprio=0, memlock=8_388_608)
    monkeypatch.setattr(doctor, "examine", lambda registry: [doctor.realtime()])

    ran = ibrobot("doctor")

    assert ran.code == 0
    assert ran.out.startswith("note  real-time priority: not permitted")
    assert PERMIT in ran.out
    page = Path(__file__).parents[2] / "docs/how-to/real-time-permissions.md"
    assert f"$ {PERMIT}\n" in page.read_text(encoding="utf-8")


def test_run_and_doctor_give_the_same_command_for_permissions(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    libc = SimpleNamespace(mlockall=lambda flags: -1)
    monkeypatch.setattr(realtime, "os", SimpleNamespace(**{**vars(os), "sched_setscheduler": refuse}))
    monkeypatch.setattr(realtime, "gc", SimpleNamespace(collect=int, freeze=int, disable=int))
    monkeypatch.setattr(realtime, "ctypes", SimpleNamespace(CDLL=lambda *_, **__: libc, get_errno=lambda: errno.ENOMEM))
    [line] = realtime.go_real_time(60)
    refused = "no real-time priority (Operation not permitted), memory is not locked (Cannot allocate memory)"
    assert line.startswith(refused)
    assert line.endswith(f"run this and log in again: {PERMIT}")


def _as_user(monkeypatch: pytest.MonkeyPatch, *, rtprio: int, memlock: int) -> None:
    limits = {resource.RLIMIT_RTPRIO: (rtprio, rtprio), resource.RLIMIT_MEMLOCK: (memlock, memlock)}
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(resource, "getrlimit", limits.__getitem__)


@pytest.mark.parametrize(("rtprio", "ok"), [(0, False), (95, True), (resource.RLIM_INFINITY, True)])
def test_real_time_permission(monkeypatch: pytest.MonkeyPatch, rtprio: int, ok: bool) -> None:
    _as_user(monkeypatch, rtprio=rtprio, memlock=0)

    assert doctor.realtime().ok is ok


@pytest.mark.parametrize(("memlock", "ok"), [(8_388_608, False), (2**30, True), (resource.RLIM_INFINITY, True)])
def test_memory_lock(monkeypatch: pytest.MonkeyPatch, memlock: int, ok: bool) -> None:
    _as_user(monkeypatch, rtprio=0, memlock=memlock)

    assert doctor.memory_lock().ok is ok


def test_root_may_do_both(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)

    assert doctor.realtime().ok
    assert doctor.memory_lock().ok


def test_all_checks_are_made(site: Site) -> None:
    site.add("fake-gl", "failing_check.py")

    names = [check.name for check in doctor.examine(discover(site.entry_points()))]

    assert names[:3] == ["python", "plugins", "GL"]
    assert names[-2:] == ["real-time priority", "memory lock"]
