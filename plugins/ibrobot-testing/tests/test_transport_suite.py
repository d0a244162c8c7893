"""The transport suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import queue
import threading
from contextlib import suppress
from typing import Any, override

import pytest
from ibrobot_testing import TransportSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeTransport

from ibrobot_core.api import TransportError


class TestTransport(TransportSuite):
    @override
    def make(self, ctx):
        return FakeTransport()

    @override
    def kill(self, far, name):
        far.kill(name)


class ShortSuite(TestTransport):
    """Waits less long for what the wrong ones never send."""

    __test__ = False
    wait_s = 0.2


class LosesEmptyPayloads(FakeTransport):
    def publish(self, topic, payload):
        if payload:
            super().publish(topic, payload)


class Reorders(FakeTransport):
    waiting = None

    def publish(self, topic, payload):
        if payload == b"7":
            self.waiting = payload
            return
        super().publish(topic, payload)
        if self.waiting is not None:
            super().publish(topic, self.waiting)
            self.waiting = None


class OneTopic(FakeTransport):
    def publish(self, topic, payload):
        for known in tuple(self._subscribers):
            super().publish(known, payload)


class NeverEnds(FakeTransport):
    """Calls the subscribers of a topic one after the other: the ended one before the others."""

    def __init__(self):
        super().__init__()
        self.callbacks = {}

    def subscribe(self, topic, callback):
        known = self.callbacks.setdefault(topic, [])
        known.append(callback)
        if len(known) == 1:
            super().subscribe(topic, lambda payload: [call(payload) for call in known])
        return lambda: None


class DeliversWhatWaits(FakeTransport):
    """Goes on with what has arrived, after the end of a subscription."""

    def subscribe(self, topic, callback):
        end = super().subscribe(topic, callback)
        listener = self._subscribers[topic][-1]
        shut = listener._pool.shutdown
        vars(listener._pool)["shutdown"] = lambda **_: shut(wait=False)
        return end


class WaitsForItsCallback(FakeTransport):
    """The end of a subscription waits for the callback, even from within."""

    def subscribe(self, topic, callback):
        end = super().subscribe(topic, callback)
        listener = self._subscribers[topic][-1]
        shut = listener._pool.shutdown
        vars(listener._pool)["shutdown"] = lambda **_: shut(wait=True, cancel_futures=True)
        return end


class TwoThreads(FakeTransport):
    """Two payloads at once."""

    def subscribe(self, topic, callback):
        end = super().subscribe(topic, callback)
        self._subscribers[topic][-1]._pool._max_workers = 2
        return end


class FailsInSilence(FakeTransport):
    def subscribe(self, topic, callback):
        def silent(payload):
            with suppress(Exception):
                callback(payload)

        return super().subscribe(topic, silent)


class CallsInTheSendersThread(FakeTransport):
    def subscribe(self, topic, callback):
        self.callbacks = [*getattr(self, "callbacks", []), callback]
        return lambda: self.callbacks.remove(callback)

    def publish(self, topic, payload):
        for callback in self.callbacks:
            callback(payload)


class DropsFailingSubscribers(FakeTransport):
    def subscribe(self, topic, callback):
        failed = threading.Event()

        def until_it_fails(payload):
            if failed.is_set():
                return
            try:
                callback(payload)
            except ValueError:
                failed.set()

        return super().subscribe(topic, until_it_fails)


class SharesAnswers(FakeTransport):
    """Answers come through one queue, in the order asked: whoever asks takes what is there."""

    def __init__(self):
        super().__init__()
        self.answers: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def request(self, name, payload, timeout_s):
        server = self._servers.get(name)
        if self._closed or server is None:
            raise TransportError(f"nobody serves {name}")
        answer = server.threads.submit(server.handler, payload, None)
        answer.add_done_callback(lambda done: self.answers.put(done.result()))
        try:
            return self.answers.get(timeout=timeout_s)
        except queue.Empty:
            raise TransportError("late") from None

    def serve(self, name, handler, *, workers=16):
        return super().serve(name, handler, workers=1)


class MixesAnswers(FakeTransport):
    def __init__(self):
        super().__init__()
        self.answers = []

    def request(self, name, payload, timeout_s):
        self.answers.append(super().request(name, payload, timeout_s))
        return self.answers[0]


class EmptyForErrors(FakeTransport):
    def request(self, name, payload, timeout_s):
        try:
            return super().request(name, payload, timeout_s)
        except TransportError as error:
            if error.__cause__ is None:
                raise
            return b""


class EmptyForNobody(FakeTransport):
    def request(self, name, payload, timeout_s):
        with self._lock:
            self._check_open()
        return super().request(name, payload, timeout_s) if name in self._servers else b""


class LastServerWins(FakeTransport):
    def serve(self, name, handler, *, workers=16):
        if name in self._servers:
            self._servers.pop(name).end()
        return super().serve(name, handler, workers=workers)


class OneCallAtATime(FakeTransport):
    def __init__(self):
        super().__init__()
        self.busy = threading.Lock()

    def publish(self, topic, payload):
        if not self.busy.acquire(timeout=0.05):
            raise TransportError("busy")
        self.busy.release()
        super().publish(topic, payload)

    def request(self, name, payload, timeout_s):
        with self.busy:
            return super().request(name, payload, timeout_s)


class KeepsBuffers(FakeTransport):
    """Hands the sender's own memory on."""

    def publish(self, topic, payload):
        for subscriber in self._subscribers.get(topic, ()):
            subscriber.put(payload)


class OneWorker(FakeTransport):
    def serve(self, name, handler, *, workers=16):
        return super().serve(name, handler, workers=1)


class WatchesOnce(FakeTransport):
    def watch(self, name, changed):
        end = super().watch(name, changed)
        end()
        return end


class ListsTheEnded(FakeTransport):
    """Names stay, although their servers have ended."""

    known: frozenset[str] = frozenset()

    def served(self, prefix):
        self.known |= super().served(prefix)
        return frozenset(name for name in self.known if name.startswith(prefix))


class AnswersWhoWaits(FakeTransport):
    """Goes on with the requests that it has, after the end of their server."""

    def serve(self, name, handler, *, workers=16):
        end = super().serve(name, handler, workers=workers)
        shut = self._servers[name].threads.shutdown
        vars(self._servers[name].threads)["shutdown"] = lambda **_: shut(wait=False)
        return end


class WaitsForTheDead(FakeTransport):
    """Nobody learns that a server has died."""

    def kill(self, *names):
        pass


class RemembersWatches(FakeTransport):
    def __init__(self):
        super().__init__()
        self.known = []

    def watch(self, name, changed):
        self.known.append(changed)
        return super().watch(name, changed)


class RemembersSubscriptions(FakeTransport):
    def __init__(self):
        super().__init__()
        self.known = []

    def subscribe(self, topic, callback):
        self.known.append(callback)
        return super().subscribe(topic, callback)


class EndsOnlyWhatIsOpen(FakeTransport):
    def _leave(self, of, key, listener):
        with self._lock:
            if listener in of[key]:
                of[key].remove(listener)
        listener.end()


class WorksWhileClosed(FakeTransport):
    def _check_open(self):
        pass


WRONG = {
    LosesEmptyPayloads: "delivers_in_order",
    Reorders: "delivers_in_order",
    OneTopic: "every_subscriber_gets_its_topic_only",
    NeverEnds: "an_ended_subscription_is_silent",
    DeliversWhatWaits: "an_ended_subscription_drops_what_waits",
    WaitsForItsCallback: "callbacks_may_end_themselves",
    TwoThreads: "a_slow_subscriber_blocks_nobody",
    FailsInSilence: "a_failing_subscriber_harms_nobody",
    CallsInTheSendersThread: "a_slow_subscriber_blocks_nobody",
    DropsFailingSubscribers: "a_failing_subscriber_harms_nobody",
    MixesAnswers: "each_request_gets_its_own_answer",
    KeepsBuffers: "sent_buffers_are_free_again",
    OneWorker: "a_slow_answer_delays_no_other",
    WatchesOnce: "a_watch_tells_who_serves",
    ListsTheEnded: "served_names_are_listed",
    SharesAnswers: "a_late_answer_is_dropped",
    EmptyForErrors: "a_servers_error_reaches_the_requester",
    EmptyForNobody: "nobody_serves",
    LastServerWins: "a_name_is_served_once",
    OneCallAtATime: "a_server_may_use_the_transport",
    AnswersWhoWaits: "an_ended_server_begins_no_request",
    WaitsForTheDead: "the_death_of_a_server_ends_what_waits_for_it",
    RemembersWatches: "ended_callbacks_do_not_accumulate",
    RemembersSubscriptions: "ended_callbacks_do_not_accumulate",
    EndsOnlyWhatIsOpen: "a_closed_transport_refuses",
    WorksWhileClosed: "a_closed_transport_refuses",
}


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(ShortSuite):
        @override
        def make(self, ctx):
            return wrong()

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(TransportSuite) == set(WRONG.values())
