"""Commands of pages, carried out in the host: each is a service of the run or its emergency stop."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any

from ibrobot_core.api import IbrobotError, PlanningError, Session, error_text, seconds
from ibrobot_web.teleop import JOG, RELEASE, Jog

Reply = Callable[[Mapping[str, Any]], None]
Handler = Callable[[Session, Mapping[str, Any]], Any]
_AT_ONCE = frozenset({"jog", "release"})
"""Commands that are carried out in the thread that receives them: they only leave a note for the teleop."""
_PREVIEW_ROWS = 40
_log = logging.getLogger("ibrobot.web")


class Commands:
    """Carries out commands, in order, in a thread; the emergency stop has its own, and waits for no other command.

    Args:
        session: the run.
        reply: sends the reply to a command.
    """

    def __init__(self, session: Session, reply: Reply) -> None:
        self._session = session
        self._reply = reply
        self._queues = {name: queue.SimpleQueue[Mapping[str, Any] | None]() for name in ("stop", "other")}
        self._threads = [
            threading.Thread(target=self._work, args=(each,), name=f"web {name}", daemon=True)
            for name, each in self._queues.items()
        ]
        for thread in self._threads:
            thread.start()

    def take(self, message: Mapping[str, Any]) -> None:
        """Carry out a command, now or as soon as its turn comes."""
        if message["do"] in _AT_ONCE:
            self._carry_out(message)
        else:
            self._queues["stop" if message["do"] == "estop" else "other"].put(message)

    def close(self, timeout_s: float) -> None:
        """End the threads; a command that is being carried out is given `timeout_s` [s]."""
        for each in self._queues.values():
            each.put(None)
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout_s)

    def _work(self, waiting: queue.SimpleQueue[Mapping[str, Any] | None]) -> None:
        while (message := waiting.get()) is not None:
            self._carry_out(message)

    def _carry_out(self, message: Mapping[str, Any]) -> None:
        reply: dict[str, Any] = {"reply": message["id"]} if "id" in message else {}
        try:
            reply["ok"] = _outcome(self._execute(message))
        except (IbrobotError, ValueError, TypeError) as error:
            reply["error"] = str(error) or type(error).__name__
        except Exception as error:  # noqa: BLE001 - contained: a page must not end the run
            reply["error"] = error_text(error)
            _log.exception("a command of the page failed")
        self._reply(reply)

    def _execute(self, message: Mapping[str, Any]) -> Any:
        handler = _HANDLERS.get(message["do"])
        if handler is None:
            raise ValueError(f"unknown command {message['do']!r}; known: {', '.join(_HANDLERS)}")
        return handler(self._session, message)


def _jog(session: Session, message: Mapping[str, Any]) -> None:
    if not session.bus.serves(JOG):
        raise IbrobotError("this mode does not jog from the page: enter a mode whose teleop is of type web")
    session.bus.call(JOG, Jog.read(message))


def _release(session: Session, message: Mapping[str, Any]) -> None:
    if session.bus.serves(RELEASE):
        session.bus.call(RELEASE)


def _joints_of(session: Session, pose: str) -> dict[str, float]:
    """The positions of a named pose [rad], of the joints that follow trajectories in this mode."""
    config = session.config
    if pose not in config.robot.description.poses:
        raise ValueError(f"no pose {pose!r}; the poses are: {', '.join(config.robot.description.poses)}")
    values = dict(zip(config.robot.joint_names, config.robot.pose(pose).tolist(), strict=True))
    executors = (config.executors[name] for name in config.control_modes[session.mode].executors)
    return {joint: values[joint] for each in executors if each.goals == "trajectory" for joint in each.joints}


def _preview(session: Session, message: Mapping[str, Any]) -> Mapping[str, Any]:
    """The path to a goal, planned and not executed: joints by index, and rows of positions [rad]."""
    goal = message.get("goal")
    if not isinstance(goal, Mapping):
        raise ValueError('goal must be an object, e.g. {"pose": "home"}')
    if "pose" in goal:
        goal = {"joints": _joints_of(session, str(goal["pose"]))}
    answer = session.bus.call("/plan_kinematic_path", {"goals": [dict(goal)]})
    if answer.trajectory is None:
        raise PlanningError(answer.message)
    points = answer.trajectory.points
    chosen = points[:: max(1, len(points) // _PREVIEW_ROWS)] + points[-1:]
    return {
        "joints": [int(i) for i in session.config.robot.indices(answer.trajectory.joint_names)],
        "rows": [[round(float(value), 4) for value in point.positions] for point in chosen],
        "duration_s": round(seconds(points[-1].time_from_start_ns), 2),
    }


def _service(name: str, argument: str | None = None) -> Handler:
    """Calls a service with a text of the message, or with None."""
    return lambda session, message: session.bus.call(name, _text(message, argument) if argument is not None else None)


_HANDLERS: Mapping[str, Handler] = {
    "estop": _service("/estop"),
    "reset": _service("/reset"),
    "mode": _service("/set_mode", "mode"),
    "jog": _jog,
    "release": _release,
    "episode_start": lambda session, message: session.bus.call(
        "/record_episode/start", _text(message, "prompt") or None
    ),
    "episode_stop": _service("/record_episode/stop", "outcome"),
    "episode_discard": _service("/record_episode/discard"),
    "smoothing": lambda session, message: session.bus.call(
        "/action_dispatcher/toggle_smoothing", message.get("enabled") is True
    ),
    "intervene": lambda session, message: session.bus.call("/intervene", message.get("take") is True),
    "preview": _preview,
    "goal": _service("/planning/go_to", "goal"),
    "cancel": _service("/planning/cancel"),
}


def _outcome(value: Any) -> Any:
    return value if isinstance(value, str | int | float | bool | Mapping) else None


def _text(message: Mapping[str, Any], name: str) -> str:
    value = message.get(name)
    if not isinstance(value, str):
        raise ValueError(f"{name} must be a text")
    return value
