"""The conformance suite of viewers."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

import numpy as np

from ibrobot_core.api import Context, Header, JointState, Message, String, Viewer
from ibrobot_core.app import Bus
from ibrobot_testing.suite import Suite


class ViewerSuite(Suite[Viewer]):
    """Checks of every `Viewer`. The subclass plays the user with `shut` and `shown`."""

    topic: ClassVar[str] = "/joint_states"
    """A topic that the viewer shows."""

    def message(self, ctx: Context, i: int) -> Message:
        """A message on `topic`, different for each `i`."""
        return JointState(Header(ctx.clock.now_ns()), ctx.robot.joint_names, np.full(6, 0.01 * i))

    def shut(self, viewer: Viewer) -> None:
        """The user closes the viewer."""
        raise NotImplementedError(f"{type(self).__name__} must define shut(self, viewer)")

    def shown(self, viewer: Viewer) -> Message:
        """The last message on `topic` that the viewer shows, or one equal to it."""
        raise NotImplementedError(f"{type(self).__name__} must define shown(self, viewer)")

    @contextmanager
    def opened(self, *, again: bool = False) -> Iterator[tuple[Viewer, Context, Bus]]:
        """An open viewer with its context and bus; for `again` see `in_use`."""
        with self.in_use(lambda viewer: viewer.open(), lambda viewer: viewer.close(), again=again) as (viewer, ctx):
            assert ctx.bus is not None
            yield viewer, ctx, ctx.bus

    def test_stays_open_until_the_person_closes_it(self) -> None:
        """`update` is True until then and False from then on, with messages and without."""
        with self.opened() as (viewer, ctx, bus):
            assert viewer.update() is True
            bus.publish(self.topic, self.message(ctx, 1))
            assert viewer.update() is True
            self.shut(viewer)
            assert viewer.update() is False
            assert viewer.update() is False

    def test_shows_the_newest(self) -> None:
        """After more messages than it can show, one `update` shows the last."""
        with self.opened() as (viewer, ctx, bus):
            for i in range(1000):
                bus.publish(self.topic, self.message(ctx, i))
            assert viewer.update() is True
            assert self.shown(viewer) == self.message(ctx, 999)

    def test_passes_over_unknown_topics(self) -> None:
        """Unknown topics are ignored, alone and after known ones."""
        with self.opened() as (viewer, _, bus):
            bus.publish("/unheard_of", String("hello"))
            assert viewer.update() is True
        with self.opened() as (viewer, ctx, bus):
            message = self.message(ctx, 1)
            bus.publish(self.topic, message)
            bus.publish("/unheard_of", String("hello"))
            assert viewer.update() is True
            assert self.shown(viewer) == message, "a message of another topic took its place"

    def test_says_where_to_look(self) -> None:
        """`where` is text, before and after `open`."""
        with self.opened() as (viewer, ctx, _):
            assert isinstance(viewer.where(), str)
            assert isinstance(self.make(ctx).where(), str)

    def test_leaves_the_bus_when_closed(self) -> None:
        """After `close` no message queues up for it."""
        with self.opened() as (viewer, ctx, bus):
            viewer.update()
            viewer.close()
            for i in range(2000):
                bus.publish(self.topic, self.message(ctx, i))
            assert bus.dropped() == {}, "a subscription was left behind"

    def test_close_is_safe_at_any_time(self) -> None:
        """`close` may come before `open` and twice; `open` works again afterwards."""
        with self.opened(again=True) as (viewer, _, _):
            assert viewer.update() is True
