"""Reads pickles without running them: classes and functions stay names, and calls stay notes of what was to be called.

Of the instructions that a pickle may have, this module knows those with which the `pickle` module and torch write plain
values, instances and tensors.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Callable, Set
from typing import Any

import attrs

from ibrobot_core.api import PolicyError

_MAX_INSTRUCTIONS = 200_000
"""In one message, with the pickles inside it."""
_MAX_WAITING = 10_000
"""Values and marks on the stack: a nested list has one for each level."""


@attrs.frozen
class Named:
    """The name of a class or function."""

    name: str


@attrs.define(eq=False)
class Made:
    """What a call of `name` would have made; `state` is what its attributes would be."""

    name: str
    arguments: tuple[Any, ...]
    state: dict[str, Any] | None = None


@attrs.frozen(eq=False)
class Reference:
    """A value outside the pickle."""

    key: Any


class PickleReader:
    """Reads the pickles of one message.

    Args:
        names: classes and functions that a pickle may name, as `module.name`; any other is an error.
    """

    def __init__(self, names: Set[str]) -> None:
        self._names = names
        self._left = _MAX_INSTRUCTIONS

    def read(self, stream: io.BytesIO) -> Any:
        """Read one pickle, and leave the stream behind it.

        Returns:
            Numbers, texts, bytes, lists, tuples and dictionaries with texts as keys; else `Named`, `Made`, `Reference`.

        Raises:
            PolicyError: if it is damaged, too large, or has a name or an instruction that is not allowed.
        """
        try:
            return self._read(stream)
        except (IndexError, KeyError, TypeError, ValueError) as error:
            raise PolicyError(f"a pickle is damaged: {type(error).__name__} at byte {stream.tell()}") from None

    def _read(self, stream: io.BytesIO) -> Any:
        content = _Content(self._names)
        while (code := stream.read(1)) != _CODE["STOP"]:
            if code not in _INSTRUCTIONS:
                raise PolicyError(f"a pickle has instruction {code!r}, not one of plain values, instances and tensors")
            self._left -= 1
            if self._left < 0 or len(content.stack) + len(content.marks) > _MAX_WAITING:
                raise PolicyError("a pickle has too many instructions, or is nested too deep")
            read, follow = _INSTRUCTIONS[code]
            follow(content, read(stream))
        return content.stack.pop()


class _Content:
    """What the instructions of one pickle have made so far.

    Args:
        names: see `PickleReader`.
    """

    def __init__(self, names: Set[str]) -> None:
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self._names = names
        self._memo: dict[int, Any] = {}

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def mark(self, _: None) -> None:
        self.marks.append(len(self.stack))

    def keep(self, place: int | None) -> None:
        self._memo[len(self._memo) if place is None else place] = self.stack[-1]

    def recall(self, place: int) -> None:
        self.stack.append(self._memo[place])

    def last(self, count: int | None) -> list[Any]:
        """Take values from the stack: so many, or those since the last mark.

        Raises:
            IndexError: if there are not so many.
        """
        start = self.marks.pop() if count is None else len(self.stack) - count
        if start < 0:
            raise IndexError
        values = self.stack[start:]
        del self.stack[start:]
        return values

    def tuple_of(self, count: int | None) -> None:
        self.stack.append(tuple(self.last(count)))

    def append(self, count: int | None) -> None:
        values = self.last(count)
        _of(list, self.stack[-1]).extend(values)

    def set_items(self, count: int | None) -> None:
        values = self.last(count)
        keys = [_of(str, key) for key in values[::2]]  # anything else could take forever to hash
        _of(dict, self.stack[-1]).update(zip(keys, values[1::2], strict=True))

    def name(self, words: list[Any]) -> None:
        """Name a class or function.

        Raises:
            PolicyError: if it is not allowed.
        """
        module, last = words
        name = f"{_of(str, module)}.{_of(str, last)}"
        if name not in self._names:
            raise PolicyError(f"a pickle names {name[:200]!r}, which is not of this protocol; nothing of it was run")
        self.stack.append(Named(name))

    def call(self, _: None) -> None:
        called, arguments = self.last(2)
        self.stack.append(Made(_of(Named, called).name, _of(tuple, arguments)))

    def build(self, _: None) -> None:
        state = _of(dict, self.stack.pop())
        _of(Made, self.stack[-1]).state = state

    def refer(self, _: None) -> None:
        self.stack.append(Reference(self.stack.pop()))


def _of[T](kind: type[T], value: Any) -> T:
    """The value, if it is of this type and of no subclass.

    Raises:
        TypeError: if not.
    """
    if type(value) is not kind:
        raise TypeError
    return value


def _nothing(stream: io.BytesIO) -> None:
    """An instruction without an argument."""


def _two_lines(stream: io.BytesIO) -> list[str]:
    """The argument of GLOBAL, without the escapes that `pickletools` would read."""
    return [stream.readline()[:-1].decode() for _ in range(2)]


def _ignore(content: _Content, argument: Any) -> None:
    """The version, and sizes of frames, which readers need not know."""


def _pushes(value: Callable[[], Any]) -> Callable[[_Content, Any], None]:
    return lambda content, _: content.push(value())


def _takes(follow: Callable[[_Content, int | None], None], count: int | None) -> Callable[[_Content, Any], None]:
    return lambda content, _: follow(content, count)


_CODE = {each.name: each.code.encode("latin-1") for each in pickletools.opcodes}
_PLAIN = (
    _CODE["BININT"], _CODE["BININT1"], _CODE["BININT2"], _CODE["LONG1"], _CODE["BINFLOAT"], _CODE["SHORT_BINUNICODE"],
    _CODE["BINUNICODE"], _CODE["SHORT_BINBYTES"], _CODE["BINBYTES"], _CODE["BINBYTES8"],
)  # fmt: skip
_FOLLOWED: dict[bytes, Callable[[_Content, Any], None]] = {
    _CODE["PROTO"]: _ignore,
    _CODE["FRAME"]: _ignore,
    _CODE["NONE"]: _pushes(lambda: None),
    _CODE["NEWTRUE"]: _pushes(lambda: True),
    _CODE["NEWFALSE"]: _pushes(lambda: False),
    _CODE["EMPTY_TUPLE"]: _pushes(tuple),
    _CODE["EMPTY_LIST"]: _pushes(list),
    _CODE["EMPTY_DICT"]: _pushes(dict),
    _CODE["MARK"]: _Content.mark,
    _CODE["MEMOIZE"]: _Content.keep,
    _CODE["BINPUT"]: _Content.keep,
    _CODE["LONG_BINPUT"]: _Content.keep,
    _CODE["BINGET"]: _Content.recall,
    _CODE["LONG_BINGET"]: _Content.recall,
    _CODE["TUPLE"]: _Content.tuple_of,
    _CODE["TUPLE1"]: _takes(_Content.tuple_of, 1),
    _CODE["TUPLE2"]: _takes(_Content.tuple_of, 2),
    _CODE["TUPLE3"]: _takes(_Content.tuple_of, 3),
    _CODE["APPEND"]: _takes(_Content.append, 1),
    _CODE["APPENDS"]: _Content.append,
    _CODE["SETITEM"]: _takes(_Content.set_items, 2),
    _CODE["SETITEMS"]: _Content.set_items,
    _CODE["GLOBAL"]: _Content.name,
    _CODE["STACK_GLOBAL"]: lambda content, _: content.name(content.last(2)),
    _CODE["REDUCE"]: _Content.call,
    _CODE["NEWOBJ"]: _Content.call,
    _CODE["BUILD"]: _Content.build,
    _CODE["BINPERSID"]: _Content.refer,
    **dict.fromkeys(_PLAIN, _Content.push),
}
_READ: dict[bytes, Callable[[io.BytesIO], Any]] = {
    _CODE[each.name]: each.arg.reader for each in pickletools.opcodes if each.arg is not None
} | {_CODE["GLOBAL"]: _two_lines}
_INSTRUCTIONS = {code: (_READ.get(code, _nothing), follow) for code, follow in _FOLLOWED.items()}
"""Code -> what reads its argument, and what it makes of it."""
