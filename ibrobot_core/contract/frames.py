"""Frames: all observations of a tick, assembled from the bus or from recorded messages by the same code."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.bus import Bus, Received
from ibrobot_core.contract.align import Sample, Stream
from ibrobot_core.contract.image import decode_image
from ibrobot_core.contract.specs import Contract, ObservationPart
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import Frame
from ibrobot_core.messages import MESSAGE_TYPES, CompressedImage, Message
from ibrobot_core.units import ns

_IMAGE_DEPTH = 32
_VECTOR_DEPTH = 256

type _Array = NDArray[np.generic]


class _Part:
    """One topic's part of an observation: its stream, and the decoded value of the last chosen sample."""

    def __init__(self, part: ObservationPart, contract: Contract) -> None:
        self.part = part
        self.stream: Stream[Message] = Stream(part.align, contract.step_ns, ns(contract.max_age))
        self._read: Callable[[Any], _Array] = (
            part.selection if part.image is None else partial(decode_image, spec=part.image, rectify=part.rectifier)
        )
        self._sample: Sample[Message] | None = None
        self._value: _Array | None = None

    def take(self, message: Message, received_ns: int) -> None:
        if message.ros_type != self.part.type and not (self.part.image and isinstance(message, CompressedImage)):
            raise ContractError(f"{self.part.key}: {self.part.topic} is a {self.part.type}, got a {message.ros_type}")
        known = MESSAGE_TYPES.get(message.ros_type)
        if known is not None and not isinstance(message, known):
            where = f"{self.part.key}: {self.part.topic}"
            raise ContractError(f"{where}: its bag defines {message.ros_type} otherwise than ROS 2 does")
        stamp_ns = getattr(getattr(message, "header", None), "stamp_ns", None)
        if stamp_ns is None and self.part.align.stamp == "header":  # of a type that only the bag defines
            raise ContractError(f"{self.part.key}: a {self.part.type} has no header; give `align: {{stamp: receive}}`")
        self.stream.add(stamp_ns, received_ns, message)

    def at(self, t_ns: int) -> _Array | None:
        if (sample := self.stream.at(t_ns)) is None:
            return None
        if sample is not self._sample:
            self._value = self._decode(sample.value)
            self._sample = sample
        return self._value

    def _decode(self, message: Message) -> _Array | None:
        """The message's value, read-only; None for a vector with unmeasured elements."""
        try:
            value = self._read(message)
        except ContractError as error:
            raise ContractError(f"{self.part.key}: {self.part.topic}: {error}") from None
        shape = self.part.feature.shape
        if any(wanted not in (-1, size) for wanted, size in zip(shape, value.shape, strict=True)):
            raise ContractError(f"{self.part.key}: {self.part.topic} gives {value.shape}, the contract says {shape}")
        if self.part.image is None and not np.isfinite(value).all():
            return None
        value.flags.writeable = False
        return value


class FrameAssembler:
    """Assembles messages into frames. Live sampling and conversion differ only in the source of the messages.

    Each sample is decoded at most once, and only if a frame needs it. Arrays in frames are read-only, since the frames
    of several ticks may share them.

    Args:
        contract: the contract that defines the frames.
        keys: the observations to assemble; None for all.

    Raises:
        ContractError: for a key that the contract does not have.
    """

    def __init__(self, contract: Contract, keys: Collection[str] | None = None) -> None:
        wanted = list(contract.observations) if keys is None else list(keys)
        unknown = [key for key in wanted if key not in contract.observations]
        if unknown:
            has = ", ".join(contract.observations) or "none"
            raise ContractError(f"the contract has no observation {unknown[0]!r}; it has: {has}")
        self._keys = {key: [_Part(part, contract) for part in contract.parts(key)] for key in wanted}
        self._topics: dict[str, list[_Part]] = {}
        for part in (part for parts in self._keys.values() for part in parts):
            self._topics.setdefault(part.part.topic, []).append(part)

    def topics(self) -> Mapping[str, bool]:
        """Topic -> whether it carries images, for all topics needed."""
        return {topic: parts[0].part.image is not None for topic, parts in self._topics.items()}

    def resets(self) -> dict[str, int]:
        """Topic -> number of jumps of its stamps, for topics with jumps."""
        counts = {topic: max(part.stream.resets for part in parts) for topic, parts in self._topics.items()}
        return {topic: count for topic, count in counts.items() if count}

    def take(self, topic: str, message: Message, received_ns: int) -> None:
        """Add a message, in the order of receipt for each topic; messages of other topics are ignored.

        Raises:
            ContractError: for a message of a type other than the contract's.
        """
        for part in self._topics.get(topic, ()):
            part.take(message, received_ns)

    def advance(self, t_ns: int) -> None:
        """Advance to tick `t_ns` [ns] without decoding; drop samples that no later tick can choose."""
        for parts in self._keys.values():
            for part in parts:
                part.stream.at(t_ns)

    def frame(self, t_ns: int) -> Frame:
        """The frame at tick `t_ns` [ns]; ticks must not decrease.

        Raises:
            ContractError: for a chosen message that does not fit the contract, e.g. one without a selected joint.
        """
        values = {}
        for key, parts in self._keys.items():
            pieces = [piece for part in parts if (piece := part.at(t_ns)) is not None]
            if len(pieces) == len(parts):
                values[key] = pieces[0] if len(pieces) == 1 else _concatenate(pieces)
        return Frame(t_ns, values, frozenset(self._keys) - frozenset(values))


class FrameSampler:
    """Samples frames from the bus. Not thread-safe.

    A frame at `t` contains everything received by `t`, so that the frame made from the recording is identical bit for
    bit. Use `Bus.snapshot_ns()` for `t`, or a tick shortly before it. Queues hold the newest 32 images or 256 other
    messages of a topic. If frames are not sampled at every tick, call `advance` at the others, or the queues overflow
    (counted by `Bus.dropped`).

    Args:
        contract: the contract that defines the frames.
        bus: the bus with the messages.
        keys: the observations to sample; None for all.
        history: number of earlier ticks in `Frame.history`. If above 0, every tick is decoded, even those for which
            neither `sample` nor `advance` was called.

    Raises:
        ContractError: for a key that the contract does not have.
    """

    def __init__(self, contract: Contract, bus: Bus, keys: Collection[str] | None = None, history: int = 0) -> None:
        self._assembler = FrameAssembler(contract, keys)
        self._step_ns = contract.step_ns
        self._history = history
        self._recent: deque[Frame] = deque(maxlen=history + 1)
        """The frames of the newest ticks, all complete, one step apart."""
        depths = {True: _IMAGE_DEPTH, False: _VECTOR_DEPTH}
        topics = self._assembler.topics()
        self._subscriptions = [bus.subscribe(topic, depths[is_image]) for topic, is_image in topics.items()]
        self._early: dict[str, Received] = {}

    def sample(self, t_ns: int) -> Frame:
        """The frame at tick `t_ns` [ns]; ticks must not decrease.

        Raises:
            ContractError: for a message that does not fit the contract.
        """
        if not self._history:
            self._drain(t_ns)
            return self._assembler.frame(t_ns)
        if self._recent:
            begin_ns = max(self._recent[-1].stamp_ns + self._step_ns, t_ns - self._history * self._step_ns)
            for skipped_ns in range(begin_ns, t_ns, self._step_ns):
                self._remember(skipped_ns)
        return self._remember(t_ns)

    def advance(self, t_ns: int) -> None:
        """Process the messages received by tick `t_ns` [ns]; decode only what a history needs."""
        if self._history:
            self.sample(t_ns)
        else:
            self._drain(t_ns)
            self._assembler.advance(t_ns)

    def close(self) -> None:
        """Unsubscribe from the bus. Safe to call twice."""
        for subscription in self._subscriptions:
            subscription.close()

    def _remember(self, t_ns: int) -> Frame:
        """The frame at `t_ns` with its history, which ends at a gap."""
        self._drain(t_ns)
        frame = self._assembler.frame(t_ns)
        if self._recent and self._recent[-1].stamp_ns == t_ns:
            self._recent.pop()
        if frame.missing:
            self._recent.clear()
            return frame
        past = tuple(self._recent)[-self._history :]
        self._recent.append(frame)
        return attrs.evolve(frame, history=past)

    def _drain(self, t_ns: int) -> None:
        """Move messages received by `t_ns` from the queues to the streams; the others stay in the bounded queues."""
        for subscription in self._subscriptions:
            while (item := self._early.pop(subscription.topic, None) or subscription.get()) is not None:
                if item.received_ns > t_ns:
                    self._early[subscription.topic] = item
                    break
                self._assembler.take(item.topic, item.message, item.received_ns)


def _concatenate(pieces: list[_Array]) -> _Array:
    joined = np.concatenate(pieces)
    joined.flags.writeable = False
    return joined
