"""Sections: one that counts joint states where a file has it, one that greets every robot but the deaf."""

from __future__ import annotations

from typing import override

import attrs

from ibrobot_core.api import Int32, Options, String, hookimpl, option
from ibrobot_core.app import CONTROL, NoRequest, SectionDescriptor, Service, SessionWorker

RESET_COUNT = Service("/reset_count", NoRequest, str, "Count from 0 again.")


@attrs.frozen
class CounterOptions(Options):
    topic: str = option("/count", help="where the count goes")


@attrs.frozen
class GreeterOptions(Options):
    word: str = option("hello", help="what it says")


class Counter(SessionWorker):
    def __init__(self, session, options):
        super().__init__(session, "counter", f"joint states, counted on {options.topic}", (CONTROL,))
        self._topic = options.topic
        self._count = 0

    @override
    def setup(self):
        self._states = self.session.bus.subscribe("/joint_states", 1)
        self.session.bus.serve(RESET_COUNT, self._reset)

    @override
    def work(self, timeout_s):
        if self._states.get(timeout_s) is not None:
            self._count += 1
            self.session.bus.publish(self._topic, Int32(self._count))

    @override
    def teardown(self):
        self.session.bus.unserve(RESET_COUNT)
        self._states.close()

    def _reset(self, request):
        self._count = 0
        return "counting from 0"


class Greeter(SessionWorker):
    def __init__(self, session, options):
        super().__init__(session, "greeter", "greets on /greeting")
        self._word = options.word if options is not None else "hi"

    @override
    def setup(self):
        self.session.bus.publish("/greeting", String(self._word), latched=True)

    @override
    def work(self, timeout_s):
        self.pause(timeout_s)


@hookimpl
def ibrobot_sections():
    yield SectionDescriptor(
        type="counter",
        summary="counts",
        options=CounterOptions,
        make=lambda options, session: Counter(session, options),
    )
    yield SectionDescriptor(
        type="greeter",
        summary="greets",
        options=GreeterOptions,
        make=lambda options, session: Greeter(session, options),
        without_section=lambda config: "deaf" not in config.robot.robot_type,
    )
