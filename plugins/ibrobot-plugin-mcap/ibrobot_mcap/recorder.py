"""Recorder `mcap`: writes episodes as rosbag2 directories."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import override

from ibrobot_ros2 import CodecError, encode
from ibrobot_ros2.jpeg import fits_jpeg, to_jpeg

from ibrobot_core.api import (
    CompressedImage,
    Context,
    ContractError,
    EpisodeEnd,
    EpisodeStart,
    Image,
    Message,
    Recorder,
    RecorderError,
    SteppedClock,
)
from ibrobot_mcap.bagfile import Item
from ibrobot_mcap.metadata import Topic
from ibrobot_mcap.options import McapOptions
from ibrobot_mcap.storage import Storage
from ibrobot_mcap.thread import WriterThread


class McapRecorder(Recorder):
    """Writes MCAP files and `metadata.yaml`.

    In real time, messages go through a bounded queue to a writer thread, so that a slow disk never delays the run; lost
    messages are counted. In lockstep they are written at once, so equal runs give equal files.
    """

    def __init__(self, options: McapOptions, ctx: Context) -> None:
        self._options = options
        self.min_free = options.min_free
        self._ctx = ctx
        self._episode: EpisodeStart | None = None
        self._storage: Storage | None = None
        self._thread: WriterThread | None = None
        self._topics: dict[str, Topic] = {}
        self._last_ns = 0

    @override
    def begin(self, episode: EpisodeStart) -> None:
        if self._episode is not None:
            raise RecorderError(f"the episode in {self._episode.directory} has not ended")
        self._storage = Storage(episode, self._options)
        if not isinstance(self._ctx.clock, SteppedClock):
            self._thread = WriterThread(self._storage, self._options.queue_size)
        self._episode, self._topics, self._last_ns = episode, {}, episode.stamp_ns

    @override
    def write(self, topic: str, message: Message, received_ns: int) -> None:
        episode, storage = self._open()
        if topic not in episode.topics and not episode.any_topic:
            return
        try:
            item = self._item(topic, message, received_ns)
        except (CodecError, ContractError, RecorderError) as error:
            raise RecorderError(f"{topic}: {error}") from error
        self._last_ns = max(self._last_ns, received_ns)
        if self._thread is not None:
            self._thread.put(item)
        else:
            storage.write(item)

    @override
    def end(self, episode: EpisodeEnd) -> Path | None:
        start, storage = self._open()
        discard = episode.outcome == "discarded"
        dropped = Counter(episode.dropped)
        failure: RecorderError | None = None
        cut = False
        if self._thread is not None:
            failure = self._thread.stop(discard=discard)
            dropped.update(self._thread.dropped)
            cut = bool(self._thread.cut)
        self._episode = self._storage = self._thread = None
        if discard:
            storage.discard()
            return None
        for topic, type_ in start.topics.items():
            if topic not in self._topics:
                storage.announce(self._topic(topic, type_))
        storage.finish(episode.outcome, dropped, episode.faults, cut=cut)
        if failure is not None:
            self._ctx.log.warning("%s ends early: %s", start.directory, failure)
        return start.directory

    @override
    def size_of(self, message: Message) -> int:
        """Size before compression of its chunk."""
        try:
            if isinstance(message, Image) and self._options.images == "jpeg" and fits_jpeg(message):
                message = to_jpeg(message, self._options.jpeg_quality)
            return len(encode(message))
        except (CodecError, ContractError, RecorderError):
            return super().size_of(message)  # writing it will raise the error

    @override
    def waiting(self) -> int:
        thread = self._thread  # `end` may remove it meanwhile
        return 0 if thread is None else thread.size

    @override
    def lost(self) -> Mapping[str, int]:
        thread = self._thread
        return {} if thread is None else thread.dropped.copy()

    @override
    def close(self) -> None:
        if self._episode is not None:
            self.end(EpisodeEnd(self._last_ns, "unknown"))

    def _open(self) -> tuple[EpisodeStart, Storage]:
        if self._episode is None or self._storage is None:
            raise RecorderError("no episode has begun")
        return self._episode, self._storage

    def _item(self, topic: str, message: Message, received_ns: int) -> Item:
        kept = self._topics.get(topic)
        if isinstance(message, Image) and self._options.images == "jpeg":
            as_jpeg = fits_jpeg(message) if kept is None else kept.type == CompressedImage.ros_type
            if as_jpeg:
                message = to_jpeg(message, self._options.jpeg_quality)
        if kept is None:
            kept = self._topics[topic] = self._topic(topic, message.ros_type)
        if message.ros_type != kept.type:
            raise RecorderError(f"carries {message.ros_type}, was {kept.type} before")
        # Encode now: the caller may change arrays afterwards.
        return Item(kept, encode(message), received_ns, received_ns)

    def _topic(self, topic: str, type_: str) -> Topic:
        bus = self._ctx.bus
        return Topic(topic, type_, latched=bus is not None and topic in bus.latched())
