"""`ibrobot doctor`: checks of this machine, with remedies."""

from __future__ import annotations

import os
import platform
import resource

import attrs

from ibrobot_core.control.realtime import PERMIT
from ibrobot_core.descriptors import Check
from ibrobot_core.errors import Unsuccessful
from ibrobot_core.plugins import Registry, installed_plugins
from ibrobot_core.safe_output import echo

_REMEDY = f"run this and log in again: {PERMIT}"
MLOCK_BYTES = 512 * 1024 * 1024
"""Memory locked by a control process with a simulation, with a margin [bytes]."""


@attrs.frozen
class Doctor:
    """Check this machine, and print a remedy for each fault; exit with 1 if an important check fails."""

    def __call__(self) -> list[Check]:
        checks = examine(installed_plugins())
        if any(check.matters and not check.ok for check in checks):
            raise Unsuccessful(checks)
        return checks

    def show(self, checks: list[Check]) -> None:
        """Print them."""
        for check in checks:
            word = "ok  " if check.ok else ("FAIL" if check.matters else "note")
            echo(f"{word}  {check.name}: {check.found}")
            if not check.ok and check.remedy:
                echo(f"      {check.remedy}")


def examine(registry: Registry) -> list[Check]:
    """Run all checks: Python, plugins and their checks, dependencies of types, real-time permissions."""
    python = Check("python", True, platform.python_version())  # an older one cannot import this file
    return [python, *plugin_checks(registry), *registry.doctor(), *types(registry), realtime(), memory_lock()]


def plugin_checks(registry: Registry) -> list[Check]:
    """One check that lists the working plugins, and a failed check per broken plugin."""
    broken = [
        Check(f"plugin {failure.plugin}", False, str(failure), f"repair or uninstall the package {failure.package}")
        for failure in registry.failures
    ]
    return [Check("plugins", True, ", ".join(registry.versions())), *broken]


def types(registry: Registry) -> list[Check]:
    """One failed check per dependency that installed types lack on this machine, or one check for all."""
    lacking: dict[tuple[str, str], list[str]] = {}
    for kind, type_ in sorted(registry.entries.keys() - registry.doubles.keys()):
        if (missing := registry.missing(kind, type_)) is not None:
            lacking.setdefault((missing.missing, missing.remedy), []).append(f"{kind} {type_}")
    checks = [Check(", ".join(names), False, *what, matters=False) for what, names in lacking.items()]
    return checks or [Check("libraries", True, "every installed type has what it needs")]


def realtime() -> Check:
    """Check whether the control process and the workers may use real-time priority."""
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
    if os.geteuid() == 0:
        verdict = "permitted (root)"
    elif limit:
        verdict = f"permitted up to {limit if limit > 0 else 99}"
    else:
        verdict = "not permitted; the control loop and images may be late under load"
    return Check("real-time priority", os.geteuid() == 0 or limit != 0, verdict, _REMEDY, matters=False)


def memory_lock() -> Check:
    """Check whether the control process may lock its memory."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    unlimited = os.geteuid() == 0 or limit == resource.RLIM_INFINITY
    allowed = "unlimited" if unlimited else f"{limit / 1e6:.0f} MB"
    return Check("memory lock", unlimited or limit >= MLOCK_BYTES, allowed, _REMEDY, matters=False)
