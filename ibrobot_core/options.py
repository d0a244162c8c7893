"""Options of plugins and config sections: attrs fields with unit, help and range, which validate their values."""

from __future__ import annotations

import inspect
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from difflib import get_close_matches
from typing import Any, TypedDict, Unpack

import attrs


@attrs.frozen
class OptionFault:
    """A conflict between an option and the rest of the robot, e.g. a joint that the robot does not have."""

    option: tuple[str | int, ...]
    """The option, or an item in it: `("inverted", 1)` is the second item of `inverted`."""
    message: str
    model: str = ""
    """The model of `robot.description` that the component needs and the robot lacks, e.g. `mjcf`."""


type OptionName = tuple[tuple[str | int, ...], str]
"""An option, as in `OptionFault`, and the name that it gives, e.g. of a topic."""


def did_you_mean(word: str, known: Sequence[str], what: str) -> str:
    """A hint for a misspelt `word`: the closest of `known`, or all of them."""
    close = get_close_matches(word, known, 1)
    return f", did you mean {close[0]!r}?" if close else f"; {what}: {', '.join(known) or 'none'}"


HIDDEN = "***"
"""Text shown in place of a secret."""


def _hidden(value: object) -> str:
    return repr(value if value is None else HIDDEN)


_LARGEST, _LONGEST_S = 1e15, 1e9
"""The largest number of an option; timers take no longer times [s]."""
_BOUNDS: Mapping[str, tuple[Callable[[Any, Any], bool], str]] = {
    "ge": (operator.ge, "small, must be at least"),
    "gt": (operator.gt, "small, must be above"),
    "le": (operator.le, "large, must be at most"),
    "lt": (operator.lt, "large, must be below"),
}


class OptionWords(TypedDict, total=False):
    """How forms and command lines show an option."""

    label: str | None
    """What forms and their errors call it; the key by default. None: it is for terminals, and not in forms."""
    more: bool
    """Whether forms show it among further options."""
    names: str
    """What a text or path names: `episodes`, `dataset`, `policy`, `robot`, `calibration`, `viewer`, or the `options` of
    another program."""
    suggest: str
    """A value that forms enter, e.g. `datasets/{episodes}`: a name in braces stands for the last part of the path given
    for the option of this name. Of several choices, the one that forms tick."""
    typed: str
    """What a command line calls it, if that is not made of the key: flags and value, e.g. `-o FILE`, or an argument,
    e.g. `EPISODES`. A value `[HZ=40]` may be left out."""


_NO_WORDS: OptionWords = {"label": "", "more": False, "names": "", "suggest": "", "typed": ""}


def option(
    default: Any = attrs.NOTHING, *, unit: str = "", help: str = "", ge: float | None = None, gt: float | None = None,
    le: float | None = None, lt: float | None = None, choices: Sequence[Any] | Mapping[str, str] | None = None,
    open: bool = False, factory: Any = None, validator: Any = None, secret: bool = False, key: str | None = None,
    plain: Any = None, **words: Unpack[OptionWords],
) -> Any:  # fmt: skip
    """An attrs field for an options class.

    Args:
        default: default value; without one, the option is required.
        unit: SI unit or word, shown in lists of options and in the JSON Schema.
        help: one-line description.
        ge: lower bound, inclusive.
        gt: lower bound, exclusive.
        le: upper bound, inclusive.
        lt: upper bound, exclusive.
        choices: the allowed values, or a mapping of them to words for forms. Each item of a tuple is one of them.
        open: whether other values than the choices are allowed, too.
        factory: creates the default, for mutable values.
        validator: a further attrs validator; its ValueError states the valid values.
        secret: whether to hide the value; recordings and `config show` contain `${NAME}` as in the YAML, else `***`.
        key: the key in the YAML, if it differs from the field's name.
        plain: type of the value in files and requests, if programs may set others as well.
        words: keys of `OptionWords`.

    Raises:
        TypeError: for another keyword.
    """
    if unknown := words.keys() - _NO_WORDS.keys():
        raise TypeError(f"option() has no keyword {', '.join(sorted(unknown))}")
    bounds = {"ge": ge, "gt": gt, "le": le, "lt": lt}
    metadata: dict[str, Any] = {"unit": unit, "help": help, **bounds, **_NO_WORDS, **words}
    metadata["choices"] = tuple(choices) if choices is not None else None
    metadata |= {"secret": secret, "plain": plain, "open": open}
    metadata["words"] = dict(choices) if isinstance(choices, Mapping) else {}
    shown: Any = _hidden if secret else True

    def check(instance: Any, attribute: attrs.Attribute[Any], value: Any) -> None:
        if value is None:
            return
        for item in value if isinstance(value, tuple) else (value,):
            if choices is not None and not open and item not in choices:
                raise ValueError(f"{item!r} is not one of: {', '.join(str(c) for c in choices)}")
            for name, bound in bounds.items():
                fits, words = _BOUNDS[name]
                if bound is not None and not fits(item, bound):  # so that NaN fits none
                    raise ValueError(f"{item} is too {words} {bound}{f' {unit}' if unit else ''}")
        if isinstance(value, float) and not abs(value) <= (_LONGEST_S if unit == "s" else _LARGEST):
            raise ValueError(f"{value} is {'too large' if math.isfinite(value) else 'not a finite number'}")

    validators = [check] if validator is None else [check, validator]
    default = default if factory is None else attrs.Factory(factory)
    return attrs.field(default=default, metadata=metadata, validator=validators, repr=shown, alias=key)


def not_empty(instance: Any, attribute: attrs.Attribute[str], value: str) -> None:
    """A validator of `option` for texts that must not be empty."""
    if not value.strip():
        raise ValueError(f"is empty; give the {attribute.metadata['help']}")


def documented[C](cls: type[C]) -> type[C]:
    """Class decorator: add the `help` and `unit` of each option to the docstring, for `help()` and the API pages."""
    lines = [
        f"    {field.alias}: {field.metadata['help']}{unit}."
        for field in attrs.fields(cls)  # type: ignore[arg-type]
        if field.metadata.get("help")
        for unit in (f" [{field.metadata['unit']}]" if field.metadata["unit"] else "",)
    ]
    cls.__doc__ = "\n".join([inspect.cleandoc(cls.__doc__ or ""), "", "Attributes:", *lines])
    return cls


def not_a_key(default: Any = attrs.NOTHING, *, factory: Any = None, repr: bool = True, eq: bool = True) -> Any:
    """An attrs field of a section's class that is set by loading, and not a key in the file."""
    default = default if factory is None else attrs.Factory(factory)
    return attrs.field(default=default, metadata={"key": False}, repr=repr, eq=eq)


_FIELDS: dict[type[Any], Mapping[str, attrs.Attribute[Any]]] = {}


def fields(kind: type[Any]) -> Mapping[str, attrs.Attribute[Any]]:
    """The keys of an options class, with resolved types."""
    if kind not in _FIELDS:
        attrs.resolve_types(kind)
        keys = (field for field in attrs.fields(kind) if field.init and field.metadata.get("key", True))
        _FIELDS[kind] = {
            str(field.alias): field.evolve(type=field.metadata["plain"]) if field.metadata.get("plain") else field
            for field in keys
        }
    return _FIELDS[kind]


def mistakes(kind: Any, base: type) -> Iterator[str]:
    """What is wrong with an options class, which derives from `base`, in words for its author."""
    if not isinstance(kind, type) or (inspect.get_annotations(kind) and "__attrs_attrs__" not in vars(kind)):
        yield f"{kind!r} is not an attrs class: give one that is decorated with @attrs.frozen"
        return
    if not issubclass(kind, base):
        yield f"{kind.__name__} does not derive from {base.__name__}: class {kind.__name__}({base.__name__})"
        return
    for field in attrs.fields(kind):  # type: ignore[arg-type]
        if inspect.isfunction(vars(base).get(field.name)):
            yield f"{kind.__name__}.{field.name} hides a method of {base.__name__}: rename it, with key='{field.alias}'"
        default = default_of(field)
        try:
            if field.validator and default is not attrs.NOTHING:
                field.validator(kind, field, default)
        except (ValueError, TypeError) as error:
            yield f"the default of {kind.__name__}.{field.alias} fails its own check: {error}"
        except AttributeError:
            continue  # its check needs the whole object


def default_of(field: attrs.Attribute[Any]) -> Any:
    """The default of a field, created by its factory if it has one; `attrs.NOTHING` if the field is required."""
    default: Any = field.default
    return default.factory() if isinstance(default, attrs.Factory) else default  # type: ignore[arg-type]
