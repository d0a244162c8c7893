"""The services that installed packages declare, and stand-ins for those of other plugins."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules, walk_packages
from typing import Any, override

import attrs

from ibrobot_core.app import NoRequest, Service

_DECLARES = re.compile(r"^[A-Z_]+(: Service\[.*\])? = Service\(", re.MULTILINE)


def declared_services() -> dict[str, Service[Any, Any]]:
    """The services that core, the installed plugins and the libraries that they share declare, by name.

    It imports the modules that declare them.
    """
    services: dict[str, Service[Any, Any]] = {}
    names = {module.name for module in iter_modules() if module.name.startswith("ibrobot_")}
    for package in sorted(names - {"ibrobot_testing"}):
        for module in walk_packages(import_module(package).__path__, f"{package}."):
            spec = module.module_finder.find_spec(module.name, None)
            assert spec is not None
            assert spec.origin is not None
            if _DECLARES.search(Path(spec.origin).read_text(encoding="utf-8")):
                mine = vars(import_module(module.name)).values()
                services |= {each.name: each for each in mine if isinstance(each, Service) and each.name}
    return dict(sorted(services.items()))


@attrs.frozen(eq=False)
class _StandIn(Service[Any, Any]):
    @override
    def read(self, request: Any, files: Callable[[str], Path] | None = None) -> Any:
        return request


def stand_in(name: str) -> Service[Any, Any]:
    """A service whose handler gets requests as they are, for tests of its callers.

    Args:
        name: its name.
    """
    return _StandIn(name, NoRequest, object)
