"""Held keys of a terminal: presses, repeats and releases, also in terminals that report presses alone."""

from __future__ import annotations

import queue
from collections import defaultdict
from typing import Literal

import attrs

from ibrobot_core.api import ns

REPEAT, RELEASE = "repeat:", "release:"
"""Prefixes of keys, e.g. `release:space`, from terminals that report these."""
_SHORTEST_DELAY_NS = ns(0.15)
"""A terminal repeats a key 0.2 to 1 s after its press, and then every 30 to 100 ms: what follows sooner is a repeat."""
_LONGEST_DELAY_NS = ns(1.5)

KeyEvent = Literal["press", "repeat", "release"]


@attrs.define
class _Key:
    state: Literal["released", "pressed", "held", "stale"] = "released"
    """`pressed` until its first repeat; `stale`: repeats of a press that does not count."""
    announced: bool = False
    """Whether `presses` had the press."""
    last_ns: int = -(10**18)


class HeldKeys:
    """Which keys are held, from what a terminal sends.

    A terminal that reports releases (kitty's protocol) sends repeats as `repeat:KEY`. Others send a held key again and
    again: an event is a new press if nothing came before it for `release_s` and no repeat follows at once. Such a
    press counts 0.15 s late. A key counts as held from its first repeat until no repeat came for `release_s`.

    Args:
        release_s: the longest time between two repeats [s].

    Attributes:
        events: what the last `take` found, in order: new presses, repeats of presses that count, and releases, if the
            terminal reports these, each with the key.
        touched: keys with a possible press in the last `take`, which may be a repeat unless `exact`.
        exact: whether the terminal has reported a repeat or release.
    """

    def __init__(self, release_s: float) -> None:
        self._release_ns = ns(release_s)
        self._keys: defaultdict[str, _Key] = defaultdict(_Key)
        self.events: list[tuple[KeyEvent, str]] = []
        self.touched: set[str] = set()
        self.exact = False

    def take(self, typed: queue.SimpleQueue[str] | None, now_ns: int) -> None:
        """Empty the queue of typed keys, None without a terminal; call it at every tick [ns]."""
        self.events, self.touched = [], set()
        while typed is not None and not typed.empty():
            event = typed.get_nowait()
            kind, _, key = event.rpartition(":") if event.startswith((REPEAT, RELEASE)) else ("", "", event)
            self.exact |= bool(kind)
            if kind == "release":
                self._release(key)
            elif kind:
                self._repeat(key, now_ns)
            else:
                self.touched.add(key)
                self._press(key, now_ns)
        for key, each in self._keys.items():
            self._age(key, each, now_ns)

    @property
    def presses(self) -> list[str]:
        """The keys that the last `take` found newly pressed."""
        return [key for event, key in self.events if event == "press"]

    def held(self, key: str) -> bool:
        """Whether a key is held."""
        return self._keys[key].state == "held"

    def toggled(self, key: str, on: bool) -> bool:
        """Whether what a key switches on and off is on after the last `take`, and was `on` before it.

        A new press switches it on. Whatever comes while it is on switches it off, and switches nothing on later.
        """
        if on and key in self.touched:
            self.forget()
            return False
        return on or key in self.presses

    def forget(self) -> None:
        """Let no press count that began before."""
        for each in self._keys.values():
            if each.state != "released":
                each.state = "stale"

    def _press(self, key: str, now_ns: int) -> None:
        each = self._keys[key]
        gap_ns, each.last_ns = now_ns - each.last_ns, now_ns
        if self.exact or gap_ns > max(self._release_ns, _LONGEST_DELAY_NS if each.state == "pressed" else 0):
            each.state, each.announced = "pressed", False
        elif each.state == "pressed" and gap_ns < _SHORTEST_DELAY_NS:
            each.state = "stale"
        elif each.state in ("pressed", "held"):
            self._repeat(key, now_ns)
        if self.exact:
            self._announce(key, each)

    def _repeat(self, key: str, now_ns: int) -> None:
        each = self._keys[key]
        each.last_ns = now_ns
        if each.state in ("pressed", "held"):
            self._announce(key, each)
            each.state = "held"
            self.events.append(("repeat", key))

    def _release(self, key: str) -> None:
        each = self._keys[key]
        if each.state == "pressed":
            self._announce(key, each)
        each.state = "released"
        self.events.append(("release", key))

    def _age(self, key: str, each: _Key, now_ns: int) -> None:
        quiet_ns = now_ns - each.last_ns
        if each.state == "pressed" and quiet_ns >= _SHORTEST_DELAY_NS:
            self._announce(key, each)
        if each.state == "held" and quiet_ns > self._release_ns:
            each.state = "stale" if self.exact else "released"

    def _announce(self, key: str, each: _Key) -> None:
        if not each.announced:
            each.announced = True
            self.events.append(("press", key))
