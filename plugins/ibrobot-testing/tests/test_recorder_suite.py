"""The recorder suite passes the fake, and each of its checks catches something wrong."""

from __future__ import annotations

import json
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_testing import RecorderSuite, checks, failed_checks
from ibrobot_testing.fakes import FakeRecorder

from ibrobot_core.api import MESSAGE_TYPES, Header, JointState


class TestRecorder(RecorderSuite):
    @override
    def make(self, ctx):
        return FakeRecorder(ctx)

    @override
    def read_back(self, path):
        kept: dict[str, list[Any]] = {}
        for text in (path / "records.jsonl").read_text().splitlines():
            line = json.loads(text)
            message = message_of(line["type"], line["message"])
            kept.setdefault(line["topic"], []).append((line["received_ns"], message))
        return kept

    @override
    def read_metadata(self, path):
        return json.loads((path / "metadata.json").read_text())

    @override
    def read_dropped(self, path):
        return self.read_metadata(path)["dropped"]


def message_of(type_: str, fields: dict[str, Any]) -> Any:
    """The message of these plain values."""
    made: dict[str, Any] = {name: Header(**value) if name == "header" else value for name, value in fields.items()}
    return MESSAGE_TYPES[type_](
        **{name: tuple(v) if name == "name" else v for name, v in made.items() if name != "layout"}
    )


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


class LosesEveryThousandth(FakeRecorder):
    count = 0

    def write(self, topic, message, received_ns):
        self.count += 1
        if self.count % 1000:
            super().write(topic, message, received_ns)


class JointStatesOnly(FakeRecorder):
    def write(self, topic, message, received_ns):
        if isinstance(message, JointState) or self._open().any_topic:
            super().write(topic, message, received_ns)


class IgnoresAnyTopic(FakeRecorder):
    def begin(self, episode):
        super().begin(attrs.evolve(episode, any_topic=False))


class LosesDropped(FakeRecorder):
    def end(self, episode):
        return super().end(attrs.evolve(episode, dropped={}))


class SizeOfNothing(FakeRecorder):
    def size_of(self, message):
        return 0


class SizeRaises(FakeRecorder):
    def size_of(self, message):
        return super().size_of(message) if isinstance(message, JointState) else len(message.name)


class SizeOfAll(FakeRecorder):
    def size_of(self, message):
        return 1000


class MetadataAtTheEnd(FakeRecorder):
    def begin(self, episode):
        super().begin(episode)
        (episode.directory / "metadata.json").unlink()


WRONG = {
    LosesEveryThousandth: "loses_nothing_of_a_long_episode",
    JointStatesOnly: "records_other_types",
    IgnoresAnyTopic: "records_any_topic_if_asked",
    LosesDropped: "keeps_what_was_lost_before",
    SizeOfNothing: "sizes_are_estimated",
    SizeRaises: "sizes_are_estimated",
    SizeOfAll: "sizes_are_estimated",
    MetadataAtTheEnd: "metadata_survives_a_crash",
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


ALONE = {
    LosesEveryThousandth,
    JointStatesOnly,
    IgnoresAnyTopic,
    LosesDropped,
    SizeOfNothing,
    SizeRaises,
    SizeOfAll,
    MetadataAtTheEnd,
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Suite(TestRecorder):
        @override
        def make(self, ctx):
            return wrong(ctx)

    failed = failed_checks(Suite, tmp_path)
    assert caught_by in failed
    if wrong in ALONE:
        assert set(failed) == {caught_by}, "no other check catches it"


def test_every_check_catches_something():
    assert checks(RecorderSuite) == set(WRONG.values())
