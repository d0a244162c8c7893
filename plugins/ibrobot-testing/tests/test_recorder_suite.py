"""The recorder suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import json
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_testing import RecorderSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeRecorder

from ibrobot_core.api import Header, JointState


class TestRecorder(RecorderSuite):
    @override
    def make(self, ctx):
        return FakeRecorder(ctx)

    @override
    def read_back(self, path):
        kept: dict[str, list[Any]] = {}
        for text in (path / "records.jsonl").read_text().splitlines():
            line = json.loads(text)
            arrays = (np.array(line[name]) for name in ("position", "velocity", "effort"))
            message = JointState(Header(line["stamp_ns"]), tuple(line["name"]), *arrays)
            kept.setdefault(line["topic"], []).append((line["received_ns"], message))
        return kept

    @override
    def read_metadata(self, path):
        return json.loads((path / "metadata.json").read_text())


class RoundsNumbers(FakeRecorder):
    def write(self, topic, message, received_ns):
        if isinstance(message, JointState):
            message = attrs.evolve(message, position=np.round(message.position, 3))
        super().write(topic, message, received_ns)


class SkipsTheFirst(FakeRecorder):
    count = 0

    def write(self, topic, message, received_ns):
        self.count += 1
        if self.count > 1:
            super().write(topic, message, received_ns)


class StampsOnWriting(FakeRecorder):
    def write(self, topic, message, received_ns):
        super().write(topic, message, received_ns + 1)


class LosesTheOutcome(FakeRecorder):
    def end(self, episode):
        return super().end(episode if episode.outcome == "discarded" else attrs.evolve(episode, outcome="success"))


class WritesOver(FakeRecorder):
    def begin(self, episode):
        if self._episode is None and episode.directory.exists():
            for path in episode.directory.iterdir():
                path.unlink()
            episode.directory.rmdir()
        super().begin(episode)


class KeepsDiscarded(FakeRecorder):
    def end(self, episode):
        super().end(attrs.evolve(episode, outcome="success"))


class RecordsEverything(FakeRecorder):
    def write(self, topic, message, received_ns):
        if not isinstance(message, JointState):
            message, topic = JointState(Header(received_ns), ()), self._open().directory.name
            assert self._episode is not None
            self._episode = attrs.evolve(self._episode, topics={**self._episode.topics, topic: ""})
        super().write(topic, message, received_ns)


class RaisesForUnknownTopics(FakeRecorder):
    def write(self, topic, message, received_ns):
        self._open().topics[topic]
        super().write(topic, message, received_ns)


class RecordsOnce(FakeRecorder):
    began = False

    def begin(self, episode):
        if self.began:
            raise RuntimeError("began already")
        super().begin(episode)
        self.began = True


class ForgetsTheOpenEpisode(FakeRecorder):
    def begin(self, episode):
        self.close()
        super().begin(episode)


class ClosesWithoutEnding(FakeRecorder):
    def close(self):
        if self._episode is not None:
            self._file.close()
            self._episode = None


class WritesAtTheEnd(FakeRecorder):
    def begin(self, episode):
        super().begin(episode)
        self._kept = []

    def write(self, topic, message, received_ns):
        self._open()
        self._kept.append((topic, message, received_ns))

    def end(self, episode):
        for item in self._kept:
            super().write(*item)
        return super().end(episode)


class LoneWriteAtTheEnd(WritesAtTheEnd):
    """As `WritesAtTheEnd`, under the other check that it fails."""


WRONG = {
    RoundsNumbers: "gives_back_what_was_written",
    SkipsTheFirst: "gives_back_what_was_written",
    StampsOnWriting: "gives_back_what_was_written",
    LosesTheOutcome: "keeps_metadata_and_outcome",
    WritesOver: "never_writes_over_anything",
    KeepsDiscarded: "a_discarded_episode_leaves_nothing",
    RecordsEverything: "unknown_topics_are_passed_over",
    RaisesForUnknownTopics: "unknown_topics_are_passed_over",
    RecordsOnce: "episodes_follow_one_another",
    ForgetsTheOpenEpisode: "refuses_calls_out_of_turn",
    ClosesWithoutEnding: "close_ends_an_open_episode",
    WritesAtTheEnd: "a_crash_costs_little",
    LoneWriteAtTheEnd: "messages_are_taken_as_they_were",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestRecorder):
        @override
        def make(self, ctx):
            return wrong(ctx)

    assert caught_by in failed_checks(Suite, tmp_path)


def test_every_check_catches_something():
    assert checks(RecorderSuite) == set(WRONG.values())
