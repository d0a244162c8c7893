"""View: devices. Runs the guides of plugins, one at a time, each in a process of its own."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import attrs
from ibrobot_terminal import Question
from ibrobot_terminal.guide import installed_guides

from ibrobot_core.api import IbrobotError, how_to_install, option
from ibrobot_core.app import (
    ChannelMessage,
    Child,
    ComponentFailed,
    installed_plugins,
)
from ibrobot_web.pictures import Picture
from ibrobot_web.ui.context import Routes, Ui

_MODULE = "ibrobot_web.ui.guide_process"
_POLL_S = 0.1
_END_S = 5.0
"""Time that a guide gets to end by itself after it was cancelled [s]."""
_LARGEST_ANSWER = 500


@attrs.define(eq=False)
class Work:
    """A guide that runs or has run."""

    name: str
    title: str
    number: int
    child: Child = attrs.field(repr=False)
    thread: threading.Thread = attrs.field(init=False, repr=False)
    items: list[dict[str, Any]] = attrs.field(factory=list)
    """What was shown: texts, tables and pictures."""
    pictures: list[bytes] = attrs.field(factory=list, repr=False)
    sight: bytes = attrs.field(default=b"", repr=False)
    """What is shown while the operator works."""
    ask: dict[str, Any] | None = None
    """What the operator is asked at present."""
    state: str = "running"
    error: str = ""
    cancelled: bool = False


class Devices:
    """The guide that runs, or has run last."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.starting = threading.Lock()
        self.work: Work | None = None

    def running(self, number: int) -> Work:
        """The guide with this number.

        Raises:
            IbrobotError: if it does not run.
        """
        if self.work is None or self.work.number != number or self.work.state != "running":
            raise IbrobotError("this guide does not run")
        return self.work

    def close(self) -> None:
        """End the guide."""
        if self.work is not None:
            self.work.cancelled = True
            self.work.thread.join()


def _follow(lock: threading.Lock, work: Work) -> None:
    """Take the messages of a guide until it ends; kill it if it was cancelled and does not end by itself."""
    child = work.child
    done = False
    while not work.cancelled and not done:
        try:
            message = child.wait(_POLL_S)
        except ComponentFailed:
            break
        if message is not None:
            done = message["event"] == "done"
            with lock:
                _take(work, message)
    child.channel.close()
    error = "" if done else "cancelled; nothing more is done" if work.cancelled else child.cause()
    child.end()
    with lock:
        work.error = error
        work.state = "done" if done else "failed"
        work.ask = None


def _take(work: Work, message: ChannelMessage) -> None:
    match message["event"]:
        case "say":
            work.items.append({"kind": "say", "text": message["text"], "warning": message["warning"]})
        case "show":
            work.items.append({"kind": "show", **_table(message)})
        case "picture":
            work.items.append({"kind": "picture", "title": message["title"], "picture": len(work.pictures)})
            work.pictures.append(bytes(message.payload))
        case "ask":
            work.ask = {name: message[name] for name in ("ask", "kind", "text")}
        case "rows" if work.ask is not None and work.ask["ask"] == message["ask"]:
            work.ask |= _table(message)
        case "sight" if work.ask is not None and work.ask["ask"] == message["ask"]:
            work.sight = bytes(message.payload)
            work.ask["sight"] = work.ask.get("sight", 0) + 1


def _table(message: Mapping[str, Any]) -> dict[str, Any]:
    return {name: message[name] for name in ("columns", "rows") if name in message}


def listing(ui: Ui) -> dict[str, Any]:
    """The guides of all plugins, with their questions, and the command that installs others if there are none."""
    guides = [
        {
            "name": guide.type,
            "title": guide.label,
            "summary": guide.summary,
            "questions": [attrs.asdict(question) for question in guide.questions()],
        }
        for guide in installed_guides()
    ]
    others = installed_plugins().official("guide").values()
    return {"guides": guides, "install": "" if guides else how_to_install(*others)}


def start(ui: Ui, name: str, answers: Mapping[str, str | bool] = option(factory=dict)) -> dict[str, int]:
    """Start a guide, with the answers to its questions, by their names."""
    guide = next((each for each in installed_guides() if each.type == name), None)
    if guide is None:
        raise IbrobotError(f"no guide {name!r}")
    given = {each.name: _answer(each, answers) for each in guide.questions()}
    devices = ui.keep(Devices)
    with devices.starting:
        before = devices.work
        if before is not None and before.state == "running":
            raise IbrobotError(f"{before.title} is running: end it first")
        number = before.number + 1 if before is not None else 1
        order = {"name": guide.type, "answers": given}
        work = Work(guide.type, guide.label, number, Child(_MODULE, order, end_s=_END_S))
        work.thread = threading.Thread(target=_follow, args=(devices.lock, work), name="guide", daemon=True)
        work.thread.start()
        devices.work = work
    return {"number": number}


def _answer(question: Question, given: Mapping[str, Any]) -> str | bool:
    value = given.get(question.name, question.default)
    if not isinstance(value, type(question.default)):
        raise IbrobotError(f"{question.text}: the answer must be a {type(question.default).__name__}")
    if isinstance(value, str) and len(value) > _LARGEST_ANSWER:
        raise IbrobotError(f"{question.text}: the answer is too long")
    if question.choices and not question.open and value not in question.choices:
        raise IbrobotError(f"{question.text}: {value!r} is not one of {', '.join(question.choices)}")
    assert isinstance(value, str | bool)
    return value


def state(ui: Ui, after: int = option(0, ge=0)) -> dict[str, Any]:
    """What the guide shows, from item number `after` on, and what it asks."""
    devices = ui.keep(Devices)
    with devices.lock:
        work = devices.work
        if work is None:
            return {"number": 0, "state": "none", "items": [], "ask": None}
        return {
            "number": work.number, "name": work.name, "title": work.title, "state": work.state, "error": work.error,
            "items": work.items[after:], "ask": work.ask,
        }  # fmt: skip


def picture(ui: Ui, picture: int = option(ge=0), n: int = 0) -> Picture:
    """A picture that the guide has shown; its number `n` keeps browsers from showing one of another guide."""
    devices = ui.keep(Devices)
    with devices.lock:
        if devices.work is None or picture >= len(devices.work.pictures):
            raise IbrobotError("no such picture")
        content = devices.work.pictures[picture]
    return Picture(content, "image/png" if content.startswith(b"\x89PNG") else "image/jpeg")


def sight(ui: Ui, sight: int = option(ge=0), n: int = 0) -> Picture:
    """What the guide shows while the operator works; the numbers keep browsers from showing an earlier one."""
    devices = ui.keep(Devices)
    with devices.lock:
        if devices.work is None or not devices.work.sight:
            raise IbrobotError("no such picture")
        return Picture(devices.work.sight, "image/jpeg")


def answer(ui: Ui, number: int, ask: int, ok: bool = True) -> None:
    """Answer what the guide asks: yes or no; yes for what is done."""
    devices = ui.keep(Devices)
    with devices.lock:
        work = devices.running(number)
        if work.ask is None or work.ask["ask"] != ask:
            raise IbrobotError("this question was answered already")
        said = ("yes" if ok else "no") if work.ask["kind"] == "confirm" else "done"
        work.items.append({"kind": "answered", "text": work.ask["text"], "answer": said, **_table(work.ask)})
        work.ask = None
        work.child.channel.send({"reply": ask, "ok": ok})


def cancel(ui: Ui, number: int) -> None:
    """End the guide where it waits for the operator; kill it if it does not end."""
    devices = ui.keep(Devices)
    with devices.lock:
        devices.running(number).cancelled = True


ROUTES: Routes = {
    "GET /list": listing,
    "GET /state": state,
    "GET /picture": picture,
    "GET /sight": sight,
    "POST /start": start,
    "POST /answer": answer,
    "POST /cancel": cancel,
}
