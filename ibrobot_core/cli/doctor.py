"""`ibrobot doctor`: what this machine has and lacks, each with its remedy."""

from __future__ import annotations

import glob
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


@attrs.frozen
class Finding:
    """A check and whether a run is impossible where it fails; otherwise it is a thing to know."""

    check: Check
    matters: bool


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print a list of {name, ok, matters, found, remedy}.")
def doctor(as_json: bool) -> None:
    """Check this machine, with the remedy for what it lacks; exit 1 if something fails that matters."""
    findings = examine(installed_plugins())
    if as_json:
        echo(json.dumps([{**attrs.asdict(f.check), "matters": f.matters} for f in findings], indent=2))
    else:
        for finding in findings:
            check = finding.check
            word = "ok  " if check.ok else ("FAIL" if finding.matters else "note")
            echo(f"{word}  {check.name}: {check.found}")
            if not check.ok and check.remedy:
                echo(f"      {check.remedy}")
    if any(finding.matters and not finding.check.ok for finding in findings):
        sys.exit(1)


def examine(registry: Registry) -> list[Finding]:
    """All checks: Python, plugins, their own checks, what types lack, serial ports, real-time permissions, disk."""
    return [
        Finding(python_version(), True),
        *(Finding(check, True) for check in plugin_checks(registry)),
        *(Finding(check, True) for check in registry.doctor()),
        *(Finding(check, False) for check in types(registry)),
        *(Finding(check, True) for check in serial_ports()),
        Finding(realtime(), False),
        Finding(memory_lock(), False),
        Finding(disk("."), True),
    ]


def python_version() -> Check:
    """The interpreter."""
    found = ".".join(str(part) for part in sys.version_info[:3])
    wanted = ".".join(str(part) for part in MINIMUM_PYTHON)
    return Check("python", sys.version_info >= MINIMUM_PYTHON, found, f"install Python {wanted} or newer")


def plugin_checks(registry: Registry) -> list[Check]:
    """How many work, and one failed check for each that does not."""
    working = sorted({entry.package for entry in registry.entries.values()})
    broken = [
        Check(f"plugin {failure.plugin}", False, str(failure), f"repair or remove it: pip uninstall {failure.package}")
        for failure in registry.failures
    ]
    return [Check("plugins", True, ", ".join(working)), *broken]


def types(registry: Registry) -> list[Check]:
    """One check for each installed type that lacks something on this machine, or one for all."""
    lacking = [
        Check(f"{kind} {type_}", False, missing.missing, missing.remedy)
        for kind, type_ in sorted(registry.entries)
        for missing in (registry.missing(kind, type_),)
        if missing is not None
    ]
    return lacking or [Check("libraries", True, "every installed type has what it needs")]


def serial_ports(patterns: tuple[str, ...] = ("/dev/ttyACM*", "/dev/ttyUSB*")) -> list[Check]:
    """Every serial port, and whether this user may open it."""
    ports = sorted(port for pattern in patterns for port in glob.glob(pattern))
    if not ports:
        return [Check("serial ports", True, "none; connect the arm if you expected one")]
    remedy = "sudo usermod -aG dialout $USER, then log in again"
    return [
        Check(f"serial port {port}", ok, "readable and writable" if ok else "no permission", remedy)
        for port in ports
        for ok in (os.access(port, os.R_OK | os.W_OK),)
    ]


def realtime() -> Check:
    """Whether the control process and the run's workers may ask for real-time priority."""
    if os.geteuid() == 0:
        return Check("real-time priority", True, "permitted (root)")
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
    if limit > 0 or limit == resource.RLIM_INFINITY:
        return Check("real-time priority", True, f"permitted up to {limit if limit > 0 else 99}")
    remedy = "add '@realtime - rtprio 95' to /etc/security/limits.d/ibrobot.conf, join group realtime, log in again"
    refused = "not permitted; the control loop and pictures may be late under load"
    return Check("real-time priority", False, refused, remedy)


def memory_lock() -> Check:
    """Whether the control process may lock its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    if os.geteuid() == 0 or limit == resource.RLIM_INFINITY:
        return Check("memory lock", True, "unlimited")
    remedy = "add '@realtime - memlock unlimited' to the same file as the real-time priority"
    return Check("memory lock", limit >= MLOCK_BYTES, f"{limit / 1e6:.0f} MB", remedy)


def disk(folder: str) -> Check:
    """Room for recordings."""
    free = shutil.disk_usage(folder).free
    remedy = f"free at least {LEAST_FREE_BYTES / 1e9:.0f} GB, or record elsewhere with recording.root"
    return Check("disk", free >= LEAST_FREE_BYTES, f"{free / 1e9:.1f} GB free in {os.path.abspath(folder)}", remedy)
