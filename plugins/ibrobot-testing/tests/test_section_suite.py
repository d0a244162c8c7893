"""The section suite passes a counter of joint states, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import Any, override

import pytest
from ibrobot_testing import SectionSuite, checks, failed_checks

from ibrobot_core.api import Int32
from ibrobot_core.app import CONTROL, NoRequest, Service, SessionWorker

RESET_COUNT = Service("/reset_count", NoRequest, str, "Count from 0 again.")


class Counter(SessionWorker):
    def __init__(self, session):
        super().__init__(session, "counter", "joint states, counted on /count", (CONTROL,))
        self.count = 0

    @override
    def setup(self):
        self.states = self.session.bus.subscribe("/joint_states", 1)
        self.session.bus.serve(RESET_COUNT, self.reset)

    @override
    def work(self, timeout_s):
        if self.states.get(timeout_s) is not None:
            self.count += 1
            self.session.bus.publish("/count", Int32(self.count))

    @override
    def teardown(self):
        self.session.bus.unserve(RESET_COUNT)
        self.states.close()

    def reset(self, request):
        self.count = 0


class TestCounter(SectionSuite):
    @override
    def component(self, session):
        return Counter(session)


class Nameless(Counter):
    def __init__(self, session):
        super().__init__(session)
        self.name = ""


class NoSummary(Counter):
    def __init__(self, session):
        super().__init__(session)
        vars(self)["summary"] = None


class NeedsOneWord(Counter):
    """As if a comma was forgotten: `("control")`."""

    def __init__(self, session):
        super().__init__(session)
        vars(self)["needs"] = CONTROL


class ServesUnexplained(Counter):
    """Offers another service than the one it resets by."""

    service = Service("/restart_count", NoRequest, str)

    def setup(self):
        super().setup()
        self.session.bus.serve(self.service, self.reset)
        self.on_end.callback(self.session.bus.unserve, self.service)

    def teardown(self):
        super().teardown()
        self.on_end.close()


class ServesANameWithoutSlash(ServesUnexplained):
    service = Service("restart_count", NoRequest, str, "Count from 0 again.")


class ServesUntyped(ServesUnexplained):
    nothing: Any = None
    service = Service("/restart_count", NoRequest, nothing, "Count from 0 again.")


class NeedsMessages(Counter):
    def work(self, timeout_s):
        received = self.states.get(timeout_s)
        assert received is not None
        assert received.message


class ServesForEver(Counter):
    def teardown(self):
        self.states.close()


class ListensForEver(Counter):
    def teardown(self):
        self.session.bus.unserve(RESET_COUNT)


WRONG = {
    Nameless: "says_what_it_is",
    NoSummary: "says_what_it_is",
    NeedsOneWord: "says_what_it_is",
    ServesUnexplained: "says_what_it_is",
    ServesANameWithoutSlash: "says_what_it_is",
    ServesUntyped: "says_what_it_is",
    NeedsMessages: "steps_without_and_with_messages",
    ServesForEver: "start_and_stop_are_safe_at_any_time",
    ListensForEver: "leaves_the_bus_when_stopped",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestCounter):
        @override
        def component(self, session):
            return wrong(session)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(SectionSuite) == set(WRONG.values())
