"""As much of draccus as LeRobot's devices need: registries of dataclasses, and decoding of flat configs."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar


class ChoiceRegistry:
    """A base class whose subclasses have names."""

    _choices: ClassVar[dict[str, type[Any]]]

    def __init_subclass__(cls) -> None:
        if ChoiceRegistry in cls.__bases__:
            cls._choices = {}

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        def register(kind: type[Any]) -> type[Any]:
            cls._choices[name] = kind
            return kind

        return register

    @classmethod
    def get_known_choices(cls) -> dict[str, type[Any]]:
        return cls._choices


def decode(kind: type[Any], raw: dict[str, Any]) -> Any:
    """The config of the class that `type` names."""
    given = dict(raw)
    chosen = kind._choices[given.pop("type")]
    known = {field.name for field in dataclasses.fields(chosen)}
    if strange := set(given) - known:
        raise ValueError(f"the fields {sorted(strange)} are not valid")
    try:
        return chosen(**given)
    except Exception as error:
        raise ValueError(f"Couldn't instantiate class {chosen.__name__} using init args {given}") from error
