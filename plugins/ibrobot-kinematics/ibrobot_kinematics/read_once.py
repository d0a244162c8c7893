"""Files that many need, and that are read once."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Any

_KEPT = 8


def read_once[**P, T](files: Callable[[Any], Iterable[Path]]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a reader: it reads again only when one of the files that the result came from has changed.

    Args:
        files: the files that a result came from.
    """

    def decorate(read: Callable[P, T]) -> Callable[P, T]:
        known: OrderedDict[object, tuple[T, list[tuple[Path, object]]]] = OrderedDict()
        reading = threading.Lock()

        @wraps(read)
        def once(*args: P.args, **kwargs: P.kwargs) -> T:
            key = (args, tuple(kwargs.items()))
            with reading:
                if key in known:
                    result, stamps = known[key]
                    if all(_stamp(path) == stamp for path, stamp in stamps):
                        known.move_to_end(key)
                        return result
                    del known[key]
                result = read(*args, **kwargs)
                known[key] = result, [(path, _stamp(path)) for path in files(result)]
                if len(known) > _KEPT:
                    known.popitem(last=False)
                return result

        return once

    return decorate


def _stamp(path: Path) -> object:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino
