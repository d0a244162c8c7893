"""The conformance suite of recorders."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, ClassVar

import attrs
import numpy as np
import pytest

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    EpisodeEnd,
    EpisodeStart,
    Float64MultiArray,
    Header,
    JointState,
    Joy,
    Message,
    Recorder,
    RecorderError,
    String,
)
from ibrobot_testing.suite import Suite

Record = tuple[int, Message]
"""Receive stamp [ns] and message."""


class RecorderSuite(Suite[Recorder]):
    """Checks of every `Recorder`. The subclass defines `read_back`, `read_metadata` and `read_dropped`."""

    topic: ClassVar[str] = "/joint_states"
    """A topic of JointState that the recorder stores."""
    max_loss_s: ClassVar[float] = 1.0
    """Maximum loss after a crash [s]."""
    joint_states_only: ClassVar[bool] = False
    """Whether the recorder is made for joint states alone; messages of other types are then not expected back."""

    def read_back(self, path: Path) -> Mapping[str, Sequence[Record]]:
        """Topic -> records, in the order written; `path` may also be a copy of an unfinished episode."""
        raise NotImplementedError(f"{type(self).__name__} must define read_back(self, path)")

    def read_metadata(self, path: Path) -> Mapping[str, str]:
        """The stored `EpisodeStart.metadata`, and `outcome`."""
        raise NotImplementedError(f"{type(self).__name__} must define read_metadata(self, path)")

    def read_dropped(self, path: Path) -> Mapping[str, int]:
        """The stored `EpisodeEnd.dropped`, topic -> messages."""
        raise NotImplementedError(f"{type(self).__name__} must define read_dropped(self, path)")

    def records(self, ctx: Context, count: int = 50) -> list[Record]:
        """JointStates at 10 Hz with awkward numbers, as received a millisecond after their stamps."""
        names = ctx.robot.joint_names
        rng = np.random.default_rng(0)
        start_ns = ctx.clock.now_ns()
        stamps = [start_ns + i * NS_PER_S // 10 for i in range(count)]
        return [(stamp + 1_000_000, JointState(Header(stamp), names, *rng.normal(size=(3, 6)))) for stamp in stamps]

    @contextmanager
    def recording(self, directory: Path) -> Iterator[tuple[Recorder, Context]]:
        """A recorder with an episode begun in `directory`, and its context."""
        ctx = self.context()
        with closing(self.make(ctx)) as recorder:
            recorder.begin(self._start(ctx, directory))
            yield recorder, ctx

    def _start(self, ctx: Context, directory: Path) -> EpisodeStart:
        topics = {self.topic: JointState.ros_type}
        return EpisodeStart(directory, ctx.clock.now_ns(), topics, {"prompt": "pick: the “cube”,\n'now'"})

    def _end(self, ctx: Context, outcome: str) -> EpisodeEnd:
        return EpisodeEnd(ctx.clock.now_ns() + 60 * NS_PER_S, outcome)

    def _saved(self, recorder: Recorder, end: EpisodeEnd) -> Path:
        path = recorder.end(end)
        assert path is not None
        return path

    def _write(self, recorder: Recorder, records: Sequence[Record]) -> None:
        for received_ns, message in records:
            recorder.write(self.topic, message, received_ns)

    def test_gives_back_what_was_written(self, tmp_path: Path) -> None:
        """Every message is reproduced bit by bit, in order, with its time of receipt."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            path = self._saved(recorder, self._end(ctx, "success"))
            assert path.is_relative_to(tmp_path / "episode")
            assert path.exists()
            assert list(self.read_back(path)[self.topic]) == self.records(ctx)

    def test_keeps_metadata_and_outcome(self, tmp_path: Path) -> None:
        """The recording contains the initial metadata and the outcome."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            path = self._saved(recorder, self._end(ctx, "failure"))
            metadata = self.read_metadata(path)
            assert metadata["prompt"] == "pick: the “cube”,\n'now'"
            assert metadata["outcome"] == "failure"

    def test_loses_nothing_of_a_long_episode(self, tmp_path: Path) -> None:
        """All of several thousand messages are reproduced."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            records = self.records(ctx, 2500)
            self._write(recorder, records)
            path = self._saved(recorder, self._end(ctx, "success"))
            sent = [received_ns for received_ns, _ in records]
            kept = [received_ns for received_ns, _ in self.read_back(path)[self.topic]]
            wrong = next((i for i, (a, b) in enumerate(zip(sent, kept, strict=False)) if a != b), None)
            assert (len(kept), wrong) == (len(sent), None)  # pytest takes minutes to compare lists as long as these

    def test_records_other_types(self, tmp_path: Path) -> None:
        """Text and arrays on topics that were announced are reproduced."""
        announced = {topic: message.ros_type for topic, message in _others(self.context()).items()}
        self._check_others(tmp_path / "episode", topics={self.topic: JointState.ros_type, **announced})

    def test_records_any_topic_if_asked(self, tmp_path: Path) -> None:
        """With `any_topic`, messages of topics that appear later are reproduced."""
        self._check_others(tmp_path / "episode", any_topic=True)

    def _check_others(self, directory: Path, **start: Any) -> None:
        """Check that messages of other types are reproduced, with these fields of `EpisodeStart`."""
        if self.joint_states_only:
            pytest.skip("records joint states only")
        ctx = self.context()
        others = _others(ctx)
        with closing(self.make(ctx)) as recorder:
            recorder.begin(attrs.evolve(self._start(ctx, directory), **start))
            for topic, message in others.items():
                recorder.write(topic, message, ctx.clock.now_ns())
            path = self._saved(recorder, self._end(ctx, "success"))
        by_topic = {topic: list(kept) for topic, kept in self.read_back(path).items() if kept}
        assert by_topic == {topic: [(ctx.clock.now_ns(), message)] for topic, message in others.items()}

    def test_keeps_what_was_lost_before(self, tmp_path: Path) -> None:
        """The recording contains the counts of messages that did not reach the recorder."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            path = self._saved(recorder, attrs.evolve(self._end(ctx, "success"), dropped={self.topic: 3}))
            assert {topic: count for topic, count in self.read_dropped(path).items() if count} == {self.topic: 3}

    def test_metadata_survives_a_crash(self, tmp_path: Path) -> None:
        """The initial metadata can be read from an episode that has not ended."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            shutil.copytree(tmp_path / "episode", tmp_path / "crashed")
            assert self.read_metadata(tmp_path / "crashed")["prompt"] == "pick: the “cube”,\n'now'"

    def test_sizes_are_estimated(self, tmp_path: Path) -> None:
        """`size_of` works for every type, before and within an episode, and grows with the message."""
        ctx = self.context()
        messages = [self.records(ctx, 1)[0][1], *_others(ctx).values()]
        with closing(self.make(ctx)) as recorder:
            assert all(recorder.size_of(message) > 0 for message in messages)
            recorder.begin(self._start(ctx, tmp_path / "episode"))
            assert all(recorder.size_of(message) > 0 for message in messages)
            small, large = (recorder.size_of(Float64MultiArray(np.ones(size))) for size in (10, 10_000))
            assert large > 100 * small

    def test_never_writes_over_anything(self, tmp_path: Path) -> None:
        """An existing directory is refused and not changed."""
        old = tmp_path / "episode" / "old.txt"
        old.parent.mkdir()
        old.write_text("old")
        with pytest.raises(RecorderError), self.recording(old.parent):
            pass
        assert [p.name for p in old.parent.iterdir()] == ["old.txt"]
        assert old.read_text() == "old"

    def test_a_discarded_episode_leaves_nothing(self, tmp_path: Path) -> None:
        """With outcome `discarded`, `end` returns None and the directory is gone."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            assert recorder.end(self._end(ctx, "discarded")) is None
        assert list(tmp_path.iterdir()) == []

    def test_unknown_topics_are_passed_over(self, tmp_path: Path) -> None:
        """A message on a topic that was not announced raises nothing and is not recorded."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            records = self.records(ctx)
            recorder.write("/unannounced", String("hello"), records[0][0])
            self._write(recorder, records)
            path = self._saved(recorder, self._end(ctx, "success"))
            assert {topic for topic, kept in self.read_back(path).items() if kept} == {self.topic}

    def test_episodes_follow_one_another(self, tmp_path: Path) -> None:
        """A second episode is a separate recording."""
        with self.recording(tmp_path / "first") as (recorder, ctx):
            records = self.records(ctx)
            self._write(recorder, records[:20])
            first = self._saved(recorder, self._end(ctx, "success"))
            recorder.begin(self._start(ctx, tmp_path / "second"))
            self._write(recorder, records[20:])
            second = self._saved(recorder, self._end(ctx, "success"))
            assert list(self.read_back(first)[self.topic]) == records[:20]
            assert list(self.read_back(second)[self.topic]) == records[20:]

    def test_refuses_calls_out_of_turn(self, tmp_path: Path) -> None:
        """`write` and `end` need an episode, and a second episode cannot begin before the first has ended."""
        ctx = self.context()
        received_ns, message = self.records(ctx, 1)[0]
        with closing(self.make(ctx)) as recorder:
            with pytest.raises(RecorderError):
                recorder.write(self.topic, message, received_ns)
            with pytest.raises(RecorderError):
                recorder.end(self._end(ctx, "success"))
            recorder.begin(self._start(ctx, tmp_path / "first"))
            with pytest.raises(RecorderError):
                recorder.begin(self._start(ctx, tmp_path / "second"))
            assert not (tmp_path / "second").exists()

    def test_close_ends_an_open_episode(self, tmp_path: Path) -> None:
        """`close` saves the open episode with outcome `unknown`; it is safe twice."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            self._write(recorder, self.records(ctx))
            recorder.close()
            recorder.close()
            assert list(self.read_back(tmp_path / "episode")[self.topic]) == self.records(ctx)
            assert self.read_metadata(tmp_path / "episode")["outcome"] == "unknown"

    def test_a_crash_costs_little(self, tmp_path: Path) -> None:
        """The files are readable at any time and lack at most the last `max_loss_s`."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            records = self.records(ctx)
            self._write(recorder, records)
            shutil.copytree(tmp_path / "episode", tmp_path / "crashed")
            messages = list(self.read_back(tmp_path / "crashed")[self.topic])
            kept = [r for r in records if r[0] <= records[-1][0] - self.max_loss_s * NS_PER_S]
            assert messages[: len(kept)] == kept

    def test_messages_are_taken_as_they_were(self, tmp_path: Path) -> None:
        """An array that changes after `write` does not change the recording."""
        with self.recording(tmp_path / "episode") as (recorder, ctx):
            received_ns, message = self.records(ctx, 1)[0]
            assert isinstance(message, JointState)
            copy = attrs.evolve(message, position=message.position.copy())
            recorder.write(self.topic, message, received_ns)
            message.position[:] = 0.0
            path = self._saved(recorder, self._end(ctx, "success"))
            assert list(self.read_back(path)[self.topic]) == [(received_ns, copy)]


def _others(ctx: Context) -> dict[str, Message]:
    """Topic -> a message that is not a joint state."""
    return {
        "/note": String("the “cube”\n"),
        "/commands": Float64MultiArray(np.array([0.1, -2.5e300, 0.0])),
        "/joy": Joy(Header(ctx.clock.now_ns(), "pad"), np.array([0.5], np.float32), np.array([1, 0], np.int32)),
    }
