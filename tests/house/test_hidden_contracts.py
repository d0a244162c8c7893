"""Nothing asks options or plugin objects for attributes that no class declares."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ALLOWED = {
    # Messages: some types have a header.
    "getattr(message, 'header', None)",
    "getattr(item.message, 'header', None)",
    "getattr(getattr(message, 'header', None), 'stamp_ns', None)",
    "getattr(getattr(item.message, 'header', None), 'stamp_ns', None)",
    "hasattr(topic.first, 'header')",
    "getattr(value, 'name', None)",
    # Errors of the standard library: some have these.
    "getattr(error, '__notes__', ())",
    "getattr(error, 'errno', None)",
    "getattr(error, 'strerror', None)",
    "getattr(error, 'reason', None)",
    # What plugins offer: Python and pluggy mark it so.
    "getattr(self.make, '__abstractmethods__', ())",
    "hasattr(written, 'ibrobot_impl')",
    # Modules, by platform or version.
    "getattr(ctypes.CDLL(None), 'mallopt', None)",
    "getattr(cv2, 'setLogLevel', None)",
    "getattr(os, 'fdatasync', os.fsync)",
    "getattr(yaml, 'CSafeLoader', yaml.SafeLoader)",
    "hasattr(resource, 'RLIMIT_RTPRIO')",
    "hasattr(os, 'memfd_create')",
    "hasattr(os, 'sched_getaffinity')",
    "hasattr(os, 'posix_fadvise')",
    # Functions with pluggy's mark on them.
    "hasattr(hook, 'ibrobot_impl')",
    # LeRobot's own policies, and torch's functions: some have these.
    "getattr(self.network, '_queues', {})",
    "getattr(func, '__name__', '')",
    "hasattr(config, 'pretrained_backbone_weights')",
    "hasattr(config, 'rtc_config')",
    "hasattr(policy, 'init_rtc_processor')",
}


FOREIGN = ROOT / "plugins/ibrobot-plugin-lerobot-devices/ibrobot_lerobot_devices/library.py"
"""It is about objects of LeRobot's and of other packages, which have attributes of their own."""


def guesses(tree: ast.AST) -> Iterator[str]:
    """Calls that ask whether something has an attribute: `hasattr`, and `getattr` of a fixed name or with a default."""
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id="hasattr")):
                yield ast.unparse(node)
            case ast.Call(func=ast.Name(id="getattr"), args=[_, name, *default]):
                if default or node.keywords or isinstance(name, ast.Constant):
                    yield ast.unparse(node)


def sources() -> Iterator[Path]:
    """The files that may have such calls: parsing all takes seconds."""
    yield from (path for path in all_sources() if re.search("hasattr|getattr", path.read_text(encoding="utf-8")))


def all_sources() -> Iterator[Path]:
    yield from (ROOT / "ibrobot_core").rglob("*.py")
    for package in (ROOT / "plugins").glob("*/*ibrobot*"):
        yield from (path for path in package.rglob("*.py") if path != FOREIGN)


def test_attributes_are_declared_and_not_guessed():
    found = {(str(path.relative_to(ROOT)), call) for path in sources() for call in guesses(ast.parse(path.read_text()))}
    assert sorted((path, call) for path, call in found if call not in ALLOWED) == []
    assert {call for _, call in found} == ALLOWED, "allowed, but nowhere used"


@pytest.mark.parametrize(
    "code", ["getattr(options, 'calibration', None)", "hasattr(options, 'topic')", "getattr(options, 'topic')"]
)
def test_the_check_finds_guesses(code: str):
    assert list(guesses(ast.parse(code))) == [code]
