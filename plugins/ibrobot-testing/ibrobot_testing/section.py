"""The conformance suite of the components of sections."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace, UnionType
from typing import Any, cast

import numpy as np

from ibrobot_core.api import Header, JointState
from ibrobot_core.app import Component, LaunchRequest, Registry, RobotConfig, Session
from ibrobot_testing.contexts import make_robot
from ibrobot_testing.suite import Suite


def make_session(**changes: Any) -> Session:
    """A run in lockstep of the robot of `make_robot`, without hardware, executors or modes.

    Args:
        changes: fields of its `RobotConfig`, e.g. `robot`.
    """
    fields = {"robot": make_robot(), "executors": {}, "control_modes": {}, "default_control_mode": "idle"}
    session = Session(RobotConfig(**{**fields, **changes}), Registry(), LaunchRequest(lockstep=True))
    control = SimpleNamespace(report={"loop": {}, "counters": {}}, running=True, call=lambda do, **arguments: {})
    session.control = cast("Any", control)
    return session


class SectionSuite(Suite[Component]):
    """Checks of every component of a section. The subclass defines `component` instead of `make`."""

    def session(self) -> Session:
        """The run; override for another robot."""
        return make_session()

    def component(self, session: Session) -> Component:
        """A new component under test, not yet started, as the descriptor's `make` gives it."""
        raise NotImplementedError(f"{type(self).__name__} must define component(self, session)")

    @contextmanager
    def started(self) -> Iterator[tuple[Component, Session]]:
        """A started component and its run."""
        session = self.session()
        component = self.component(session)
        try:
            component.start()
            yield component, session
        finally:
            component.stop()

    def test_says_what_it_is(self) -> None:
        """`name` and `summary` are text, for the plan that `--dry-run` prints; services say what they do."""
        with self.started() as (component, session):
            for told in ("name", "summary"):
                text = getattr(component, told)
                assert isinstance(text, str), f"{told} is {text!r}"
                assert text, f"{told} is empty"
            assert isinstance(component.needs, tuple), f"needs is {component.needs!r}: write a tuple of names"
            others = self.session().bus.services()
            for name, service in session.bus.services().items():
                if name in others:
                    continue
                assert name.startswith("/"), f"the service {name!r}: its name must begin with /"
                assert service.help, f"the service {name} has no help"
                assert isinstance(service.answer, type | UnionType), f"the service {name} states no type of its answer"

    def test_steps_without_and_with_messages(self) -> None:
        """A tick of lockstep does not need messages, and takes joint states."""
        with self.started() as (component, session):
            joints = session.config.robot.joint_names
            for _ in range(3):
                component.step(session.clock.now_ns())
                session.bus.publish("/joint_states", JointState(Header(1), joints, np.zeros(len(joints))))

    def test_start_and_stop_are_safe_at_any_time(self) -> None:
        """`stop` may be called before `start` and twice; `start` works again afterwards, with the same services."""
        session = self.session()
        component = self.component(session)
        component.stop()
        for _ in range(2):
            component.start()
            component.stop()
            component.stop()

    def test_leaves_the_bus_when_stopped(self) -> None:
        """After `stop` no message queues up for it."""
        with self.started() as (component, session):
            component.stop()
            joints = session.config.robot.joint_names
            for _ in range(2000):
                session.bus.publish("/joint_states", JointState(Header(1), joints, np.zeros(len(joints))))
            assert session.bus.dropped() == {}, "a subscription was left behind"
