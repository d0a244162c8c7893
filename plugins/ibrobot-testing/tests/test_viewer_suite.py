"""The viewer suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

from typing import override

import pytest
from ibrobot_testing import ViewerSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeViewer

from ibrobot_core.api import JointState


class TestViewer(ViewerSuite):
    @override
    def make(self, ctx):
        return FakeViewer(ctx)

    @override
    def shut(self, viewer):
        viewer.person_closed = True

    @override
    def shown(self, viewer):
        return viewer.shown


class NeverCloses(FakeViewer):
    def update(self):
        super().update()
        return True


class ClosesWithoutMessages(FakeViewer):
    def update(self):
        return super().update() and self.shown is not None


class ShowsTheOldest(FakeViewer):
    def open(self):
        self._subscription = self._bus.subscribe("/joint_states", depth=1000)


class WantsJointStates(FakeViewer):
    def open(self):
        super().open()
        self._others = self._bus.subscribe(None, depth=1)

    def close(self):
        super().close()
        if hasattr(self, "_others"):
            self._others.close()

    def update(self):
        received = self._others.get()
        if received is not None:
            assert isinstance(received.message, JointState)
            return super().update() and len(received.message.name) > 0
        return super().update()


class ShowsAnyTopic(FakeViewer):
    def open(self):
        self._subscription = self._bus.subscribe(None, depth=1)


class NowhereToLook(FakeViewer):
    def where(self):
        return None


class StaysOnTheBus(FakeViewer):
    def close(self):
        self._subscription = None


class ClosesOnce(FakeViewer):
    def close(self):
        assert self._subscription is not None
        self._subscription.close()
        self._subscription = None


WRONG = {
    NeverCloses: "stays_open_until_the_person_closes_it",
    ClosesWithoutMessages: "stays_open_until_the_person_closes_it",
    ShowsTheOldest: "shows_the_newest",
    ShowsAnyTopic: "passes_over_unknown_topics",
    WantsJointStates: "passes_over_unknown_topics",
    NowhereToLook: "says_where_to_look",
    StaysOnTheBus: "leaves_the_bus_when_closed",
    ClosesOnce: "close_is_safe_at_any_time",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestViewer):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(ViewerSuite) == set(WRONG.values())
