"""`ibrobot doctor`: what this machine has and lacks, each with its remedy."""

from __future__ import annotations

import json
import os
import resource
import shutil
import sys

import attrs
import click

from ibrobot_core.descriptors import Check
from ibrobot_core.outside import echo
from ibrobot_core.plugins import Registry, installed_plugins

MINIMUM_PYTHON = (3, 12)
LEAST_FREE_BYTES = 2_000_000_000
MLOCK_BYTES = 512 * 1024 * 1024
"""What a control process with a simulation in it locks, with room to spare."""


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print a list of {name, ok, matters, found, remedy}.")
def doctor(as_json: bool) -> None:
    """Check this machine, with the remedy for what it lacks; exit 1 if something fails that matters."""
    checks = examine(installed_plugins())
    if as_json:
        echo(json.dumps([attrs.asdict(check) for check in checks], indent=2))
    else:
        for check in checks:
            word = "ok  " if check.ok else ("FAIL" if check.matters else "note")
            echo(f"{word}  {check.name}: {check.found}")
            if not check.ok and check.remedy:
                echo(f"      {check.remedy}")
    if any(check.matters and not check.ok for check in checks):
        sys.exit(1)


def examine(registry: Registry) -> list[Check]:
    """All checks: Python, plugins, their own checks, what types lack, real-time permissions, disk."""
    return [
        python_version(), *plugin_checks(registry), *registry.doctor(), *types(registry), realtime(), memory_lock(),
        disk("."),
    ]  # fmt: skip


def python_version() -> Check:
    """The interpreter."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    wanted = ".".join(str(part) for part in MINIMUM_PYTHON)
    return Check("python", sys.version_info >= MINIMUM_PYTHON, found, f"install Python {wanted} or newer")


def plugin_checks(registry: Registry) -> list[Check]:
    """How many work, and one failed check for each that does not."""
    broken = [
        Check(f"plugin {failure.plugin}", False, str(failure), f"repair or remove it: pip uninstall {failure.package}")
        for failure in registry.failures
    ]
    return [Check("plugins", True, ", ".join(registry.versions())), *broken]


def types(registry: Registry) -> list[Check]:
    """One check for each installed type that lacks something on this machine, or one for all."""
    lacking = [
        Check(f"{kind} {type_}", False, missing.missing, missing.remedy, matters=False)
        for kind, type_ in sorted(registry.entries)
        for missing in (registry.missing(kind, type_),)
        if missing is not None
    ]
    return lacking or [Check("libraries", True, "every installed type has what it needs")]


def realtime() -> Check:
    """Whether the control process and the run's workers may ask for real-time priority."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
    if os.geteuid() == 0:
        found = "permitted (root)"
    elif limit:
        found = f"permitted up to {limit if limit > 0 else 99}"
    else:
        found = "not permitted; the control loop and pictures may be late under load"
    remedy = "add '@realtime - rtprio 95' to /etc/security/limits.d/ibrobot.conf, join group realtime, log in again"
    return Check("real-time priority", os.geteuid() == 0 or limit != 0, found, remedy, matters=False)


def memory_lock() -> Check:
    """Whether the control process may lock its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = os.geteuid() == 0 or limit == resource.RLIM_INFINITY
    found = "unlimited" if unlimited else f"{limit / 1e6:.0f} MB"
    remedy = "add '@realtime - memlock unlimited' to the same file as the real-time priority"
    return Check("memory lock", unlimited or limit >= MLOCK_BYTES, found, remedy, matters=False)


def disk(folder: str) -> Check:
    """Room for recordings."""
    free = shutil.disk_usage(folder).free
    remedy = f"free at least {LEAST_FREE_BYTES / 1e9:.0f} GB, or record elsewhere with recording.root"
    return Check("disk", free >= LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free in {os.path.abspath(folder)}", remedy)
