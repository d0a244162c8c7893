"""What happens at the same moment as the end of an agent's authority, with a control that notes its commands."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from ibrobot_terminal.authority import Authority, Grant, authority_of
from ibrobot_testing import make_session, stand_in

from ibrobot_core.api import RealClock, ns
from ibrobot_core.app import Session

GRANT = Grant(60.0, ("/test/move",), speed=0.2)


def armed(call: Callable[[Any], None], write_plan: Callable[[Any], None]) -> tuple[Session, Authority]:
    session = make_session()

    def carried_out(command: Any, **more: Any) -> dict[str, Any]:
        call(command)
        return {}

    control = {"report": {"loop": {}, "counters": {}}, "running": True, "call": carried_out, "write_plan": write_plan}
    session.control = cast("Any", SimpleNamespace(**control, stops=0))

    def enter(_: Any) -> None:
        session.held = False

    session.bus.serve(stand_in("/set_mode"), enter)
    authority = authority_of(session)
    authority.open()
    authority.join("claude")
    authority.arm(GRANT)
    return session, authority


def test_plan_that_was_admitted_does_not_overtake_the_end_of_the_authority() -> None:
    plans: list[Any] = []
    session, authority = armed(lambda command: None, plans.append)
    ending = threading.Thread(target=authority.end, args=("disarmed",))
    admits = authority.admits_plan

    def late(joints: tuple[str, ...], positions: Any) -> bool:
        admitted = admits(joints, positions)
        ending.start()
        ending.join(0.3)
        return admitted

    authority.admits_plan = late  # type: ignore[method-assign]
    joints = session.config.robot.joint_names
    session.send_plan(0, 1, joints, np.ones((5, len(joints))))
    ending.join()
    assert len(plans) == 3, "the plan, and the brake twice"
    assert not plans[-1].mask.any()
    authority.close()


def test_authority_of_a_run_keeps_the_lock_of_those_who_send() -> None:
    """A plan may be on its way while the first door for agents, or page that shows them, asks for it."""
    session = make_session()
    sending = session.authority.lock
    authority = authority_of(session)
    assert authority.lock is sending
    assert authority_of(session) is authority is session.authority


def test_listener_that_stops_listening_keeps_no_event_from_the_others() -> None:
    _, authority = armed(lambda command: None, lambda plan: None)
    events: list[str] = []

    def once(_: Any) -> None:
        authority.told.remove(once)

    authority.told += [once, lambda entry: events.append(entry["event"])]
    authority.end("disarmed")
    assert events == ["ended"]
    authority.close()


def test_end_of_an_authority_does_not_lift_the_speed_limit_of_the_next_one() -> None:
    speeds: list[float] = []
    again: list[Grant] = []

    def call(command: Any) -> None:
        if type(command).__name__ == "LimitSpeed":
            speeds.append(command.fraction)
        if type(command).__name__ == "CancelGoals" and again:
            authority.arm(again.pop())

    _, authority = armed(call, lambda plan: None)
    again.append(GRANT)
    authority.end("its time is over")
    assert authority.status().grant is GRANT
    assert speeds[-1] == GRANT.speed
    authority.close()
    assert speeds[-1] == 1.0


def test_grant_lasts_as_long_as_it_says_whatever_the_time_of_day(monkeypatch: pytest.MonkeyPatch) -> None:
    passed_s, day_s = [100], [1_800_000_000]
    times = {"monotonic_ns": lambda: ns(passed_s[0]), "time_ns": lambda: ns(day_s[0])}
    monkeypatch.setattr(sys.modules[RealClock.__module__], "time", SimpleNamespace(**times))
    session, authority = armed(lambda command: None, lambda plan: None)
    session.clock = RealClock()
    authority.arm(GRANT)
    for later_s, shift_s, is_armed in [(30, -86_400, True), (29, 10 * 86_400, True), (2, -10 * 86_400, False)]:
        passed_s[0] += later_s
        day_s[0] += shift_s
        authority.renew(authority._agents[0])
        authority.check()
        assert bool(authority.status().armed) is is_armed
    assert authority.status().ended == "its time is over"
    authority.close()
