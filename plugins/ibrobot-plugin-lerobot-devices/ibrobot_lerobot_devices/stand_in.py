"""A stand-in for torch in device processes, where LeRobot's devices import it and do not use it.

Importing torch takes most of the time and memory of a device process. Names of the stand-in may be imported, and used
in annotations and `isinstance`; whatever calls one gets an error that says what to do.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, NoReturn, override

_NAME = "torch"
NEEDS_TORCH = "torch is not loaded for this device: set torch: true"
"""Text in the error of a call of the stand-in."""


class _Placeholder(type):
    """The class of every name of the stand-in."""

    def __getattr__(cls, name: str) -> Any:
        return _placeholder(name, f"{cls.__module__}.{cls.__qualname__}")

    def __getitem__(cls, key: Any) -> Any:
        return cls

    def __or__(cls, other: Any) -> Any:
        return cls

    __ror__ = __or__

    def __call__(cls, *arguments: Any, **options: Any) -> NoReturn:
        raise RuntimeError(f"calls {cls.__module__}.{cls.__qualname__}, and {NEEDS_TORCH}")


def _placeholder(name: str, module: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    return type.__new__(_Placeholder, name, (), {"__module__": module})


class _Module(ModuleType):
    __version__ = "0"

    def __getattr__(self, name: str) -> Any:
        placeholder = _placeholder(name, self.__name__)
        setattr(self, name, placeholder)
        return placeholder


class _Finder(MetaPathFinder, Loader):
    @override
    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        wanted = fullname == _NAME or fullname.startswith(f"{_NAME}.")
        return ModuleSpec(fullname, self, is_package=True) if wanted else None

    @override
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Module(spec.name)

    @override
    def exec_module(self, module: ModuleType) -> None:
        """There is nothing to run."""


def replace_torch() -> None:
    """Let every later `import torch` find the stand-in."""
    sys.meta_path.insert(0, _Finder())
