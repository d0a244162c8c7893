"""A plugin that does one wrong thing, which its name says: `bad__WHERE__DEED`, with the name of a hook or `import`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import (
    Check,
    Command,
    ConfigFile,
    DecoderDescriptor,
    FeatureDescriptor,
    HardwareDescriptor,
    ReaderDescriptor,
    SensorDescriptor,
)

_, _where, _deed = __name__.split("__")


class Unprintable(Exception):
    """An error whose text is an error."""

    def __str__(self) -> str:
        raise RuntimeError("no text")


def _nothing(*arguments: object) -> None:
    """Do nothing."""


RAISED: Mapping[str, BaseException] = {
    "exception": RuntimeError("no driver"),
    "base": BaseException("no base"),
    "interrupt": KeyboardInterrupt(),
    "exit": SystemExit(3),
    "generator_exit": GeneratorExit(),
    "unprintable": Unprintable(),
}
YIELDED: Mapping[str, object] = {
    "number": 3,
    "none": None,
    "text": "good_arm",
    "kind": HardwareDescriptor if _where == "ibrobot_hardware" else HardwareDescriptor("x", _nothing, "x"),  # type: ignore[arg-type]
    "other": SensorDescriptor("x", _nothing, "x"),  # type: ignore[arg-type]
}
WITHOUT_NAME: Mapping[str, Callable[[], object]] = {
    "ibrobot_hardware": lambda: HardwareDescriptor(3, _nothing, "x"),  # type: ignore[arg-type]
    "ibrobot_sensors": lambda: SensorDescriptor("x", _nothing, "x", options=3),  # type: ignore[arg-type]
    "ibrobot_readers": lambda: ReaderDescriptor(None, "x", _nothing, _nothing),  # type: ignore[arg-type]
    "ibrobot_decoders": lambda: DecoderDescriptor,
    "ibrobot_features": lambda: FeatureDescriptor(3, _nothing, _nothing, _nothing),  # type: ignore[arg-type]
    "ibrobot_configs": lambda: ConfigFile("x", "robot.yaml"),  # type: ignore[arg-type]
    "ibrobot_commands": lambda: Command(3),  # type: ignore[arg-type]
    "ibrobot_doctor": lambda: Check("x", True, 3),  # type: ignore[arg-type]
}


def _wrong(**arguments: object) -> Iterator[object]:
    if _deed in RAISED:
        raise RAISED[_deed]
    yield WITHOUT_NAME[_where]() if _deed == "nameless" else YIELDED[_deed]


def _number() -> int:
    return 3


def _event(robot: str) -> None:
    raise RAISED[_deed]


if _where == "import":
    raise RAISED[_deed]
_function = {"returned": _number}.get(_deed, _wrong)
globals()[_where] = hookimpl(_event if _where == "ibrobot_mode_changed" else _function)
