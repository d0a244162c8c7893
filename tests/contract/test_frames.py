"""Frames live and offline: equal bit by bit, over streams that jitter, come late, twice, out of order or not at all."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_testing.contexts import ARM, GRIPPER, START_NS
from ibrobot_testing.images import encode_image

from ibrobot_core.bus import Bus
from ibrobot_core.clock import SteppedClock
from ibrobot_core.contract import frames as frames_module
from ibrobot_core.contract import image as image_module
from ibrobot_core.contract.frames import FrameAssembler, FrameSampler
from ibrobot_core.contract.image import decode_image
from ibrobot_core.contract.specs import Contract
from ibrobot_core.descriptors import DecoderDescriptor
from ibrobot_core.errors import ContractError
from ibrobot_core.interfaces.policy import Frame
from ibrobot_core.messages import CompressedImage, Float64MultiArray, Header, Image, Imu, JointState, Message, Vector3
from ibrobot_core.plugins import Registry
from ibrobot_core.schema import Align, ImageSpec, ObservationSpec

Make = Callable[..., Any]
MS = 1_000_000
NAMES = GRIPPER + ARM

OBSERVATIONS = (
    ObservationSpec("observation.state", topic="/joint_states"),
    ObservationSpec("observation.motion", topic="/joint_states", select=("velocity.gripper",), align=Align("drop")),
    ObservationSpec(
        "observation.motion",
        topic="/imu",
        type="sensor_msgs/msg/Imu",
        select=("angular_velocity",),
        align=Align("asof", "header", 80.0),
    ),
    ObservationSpec(
        "observation.images.top",
        peripheral="top",
        image=ImageSpec(resize=(2, 3)),
        align=Align("asof", "header", 60.0),
    ),
    ObservationSpec("observation.scene", topic="/scene", type="std_msgs/msg/Float64MultiArray", align=Align("drop")),
)


def frames(
    assembler: FrameAssembler, messages: Iterable[tuple[str, Message, int]], ticks: Iterable[int]
) -> Iterator[Frame]:
    """Take the messages received by each tick, as a conversion does, and then its frame."""
    coming = deque(messages)
    for t_ns in ticks:
        while coming and coming[0][2] <= t_ns:
            assembler.take(*coming.popleft())
        yield assembler.frame(t_ns)


def joint_state(stamp_ns: int, value: float) -> JointState:
    return JointState(Header(stamp_ns), NAMES, np.arange(6) + value, np.full(6, value), np.full(6, np.nan))


def image(stamp_ns: int, value: float) -> Message:
    pixels = np.random.default_rng(int(value)).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    return encode_image(pixels, "rgb8", Header(stamp_ns), padding=int(value) % 3)


MAKERS: dict[str, Callable[[int, float], Message]] = {
    "/joint_states": joint_state,
    "/imu": lambda stamp_ns, value: Imu(Header(stamp_ns), angular_velocity=Vector3(value, 0, -value)),
    "/camera/top/image_raw": image,
    "/scene": lambda stamp_ns, value: Float64MultiArray([value] * 3),
    "/elsewhere": lambda stamp_ns, value: Float64MultiArray([value]),
}


@pytest.fixture(scope="module")
def contract(make_config: Make) -> Contract:
    return Contract.from_config(make_config(OBSERVATIONS))


def equal(one: Frame, other: Frame) -> bool:
    same = (one.stamp_ns, one.missing, list(one.values)) == (other.stamp_ns, other.missing, list(other.values))
    arrays = ((one.values[key], other.values[key]) for key in one.values) if same else ()
    return same and all(a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in arrays)


latency = st.one_of(st.integers(-20, 90), st.sampled_from([0, 0, 0, 500, 1500, -1500, 5000]))
publications = st.tuples(st.just("publish"), st.sampled_from(list(MAKERS)), st.integers(0, 40), latency, st.booleans())
samplings = st.tuples(st.sampled_from(["sample", "advance"]), st.integers(0, 60))


@settings(max_examples=200, deadline=None)
@given(events=st.lists(st.one_of(publications, publications, publications, samplings), max_size=80))
def test_live_and_offline_are_equal_bit_by_bit(contract: Contract, events: list[Any]) -> None:
    """Ticks lie behind the clock by up to 60 ms: what came meanwhile is in the queues, and must not count."""
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus)
    bag: list[tuple[str, Message, int]] = []
    live: list[Frame] = []
    tick_ns = 0
    for number, (kind, *event) in enumerate(events):
        if kind == "publish":
            topic, wait, late, twice = event
            clock.advance(wait * MS)
            message = MAKERS[topic](clock.now_ns() - late * MS, float(number))
            for _ in range(1 + twice):
                bus.publish(topic, message)
                bag.append((topic, message, clock.now_ns()))
            continue
        tick_ns = max(tick_ns, bus.snapshot_ns() - event[0] * MS)
        if kind == "sample":
            live.append(sampler.sample(tick_ns))
        else:
            sampler.advance(tick_ns)
        clock.advance(1)
    assert bus.dropped() == {}
    ticks = [frame.stamp_ns for frame in live]
    offline = list(frames(FrameAssembler(contract), bag, ticks))
    assert len(offline) == len(live)
    assert all(equal(a, b) for a, b in zip(live, offline, strict=True))
    # Which other ticks there are makes no difference either.
    between = sorted({*ticks, *range(START_NS, clock.now_ns(), 7 * MS)})
    denser = {frame.stamp_ns: frame for frame in frames(FrameAssembler(contract), bag, between)}
    assert all(equal(denser[frame.stamp_ns], frame) for frame in live)


def offline(contract: Contract, messages: Iterable[tuple[str, Message, int]], *ticks: int) -> list[Frame]:
    return list(frames(FrameAssembler(contract), messages, ticks))


def test_a_frame_has_what_is_there_and_names_what_is_not(contract: Contract) -> None:
    bag = [("/joint_states", joint_state(10 * MS, 1.0), 11 * MS), ("/imu", MAKERS["/imu"](12 * MS, 2.0), 13 * MS)]
    before, first, both = offline(contract, bag, 10 * MS, 11 * MS, 14 * MS)
    assert before.values == {}
    assert before.missing == set(contract.observations)
    assert list(first.values) == ["observation.state"]
    state = first.values["observation.state"]
    assert state.dtype == np.float32
    np.testing.assert_array_equal(state, [2, 3, 4, 5, 6, 1])  # the robot's order, not the sender's
    np.testing.assert_array_equal(both.values["observation.motion"], [1, 2, 0, -2])
    assert both.missing == {"observation.images.top", "observation.scene"}
    assert both.stamp_ns == 14 * MS


def test_a_key_is_missing_when_any_of_its_parts_is(contract: Contract) -> None:
    imu = ("/imu", MAKERS["/imu"](10 * MS, 2.0), 10 * MS)
    state = ("/joint_states", joint_state(10 * MS, 1.0), 10 * MS)
    assert "observation.motion" in offline(contract, [imu], 11 * MS)[0].missing
    assert "observation.motion" in offline(contract, [state], 11 * MS)[0].missing
    there, gone = offline(contract, [imu, state], 11 * MS, 10 * MS + contract.step_ns)
    assert "observation.motion" in there.values
    assert "observation.motion" in gone.missing


def test_a_vector_with_something_not_measured_is_missing(make_config: Make) -> None:
    spec = ObservationSpec("observation.effort", topic="/joint_states", select=("effort.gripper", "position.gripper"))
    contract = Contract.from_config(make_config([spec]))
    frame = offline(contract, [("/joint_states", joint_state(0, 1.0), 0)], 0)[0]
    assert frame.missing == {"observation.effort"}


def test_only_the_keys_asked_for_are_sampled(contract: Contract) -> None:
    bus = Bus(SteppedClock(START_NS))
    sampler = FrameSampler(contract, bus, keys=["observation.scene"])
    for topic, make in MAKERS.items():
        bus.publish(topic, make(START_NS, 1.0))
    frame = sampler.sample(START_NS)
    assert list(frame.values) == ["observation.scene"]
    assert frame.missing == frozenset()
    with pytest.raises(ContractError, match=r"no observation 'observation.sta'; it has: observation.state, "):
        FrameSampler(contract, bus, keys=["observation.sta"])


def test_samples_are_decoded_once_and_only_when_a_frame_asks(
    contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[int] = []
    decode = decode_image

    def counting(message: Any, spec: ImageSpec, rectify: Any) -> Any:
        decoded.append(message.header.stamp_ns)
        return decode(message, spec, rectify)

    monkeypatch.setattr(frames_module, "decode_image", counting)
    assembler = FrameAssembler(contract, keys=["observation.images.top"])
    for k in range(10):
        assembler.take("/camera/top/image_raw", image(k * 10 * MS, k), k * 10 * MS)
        assembler.advance(k * 10 * MS)
    assert decoded == []
    first, second = assembler.frame(95 * MS), assembler.frame(100 * MS)
    assert decoded == [90 * MS]
    assert first.values["observation.images.top"] is second.values["observation.images.top"]


def test_compressed_pictures_are_decoded_once_and_only_when_a_frame_asks(
    contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[int] = []

    def grey(picture: CompressedImage) -> Image:
        decoded.append(picture.header.stamp_ns)
        return encode_image(np.full((4, 6, 3), picture.data[0], np.uint8), "rgb8", picture.header)

    registry = Registry(decoders=[DecoderDescriptor(("grey",), lambda: grey)])
    monkeypatch.setattr(image_module, "installed_plugins", lambda: registry)
    assembler = FrameAssembler(contract, keys=["observation.images.top"])
    for k in range(10):
        picture = CompressedImage(Header(k * 10 * MS), "grey", np.array([k], np.uint8))
        assembler.take("/camera/top/image_raw", picture, k * 10 * MS)
        assembler.advance(k * 10 * MS)
    first, second = assembler.frame(95 * MS), assembler.frame(100 * MS)
    assert decoded == [90 * MS]
    assert first.values["observation.images.top"] is second.values["observation.images.top"]
    assert (first.values["observation.images.top"] == 9).all()


def test_arrays_of_frames_are_read_only_and_messages_are_not_touched(contract: Contract) -> None:
    message: Any = image(0, 0.0)
    bag = [("/camera/top/image_raw", message, 0), ("/joint_states", joint_state(0, 1.0), 0)]
    bag.append(("/imu", MAKERS["/imu"](0, 1.0), 0))
    frame = offline(contract, bag, 1)[0]
    assert len(frame.values) == 3
    assert not any(array.flags.writeable for array in frame.values.values())
    assert message.data.flags.writeable


def test_queues_are_bounded_and_loss_is_counted(contract: Contract) -> None:
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus)
    for k in range(40):
        bus.publish("/camera/top/image_raw", image(clock.advance(MS), k))
    assert bus.dropped() == {"/camera/top/image_raw": 8}
    newest = sampler.sample(clock.now_ns()).values["observation.images.top"]
    sampler.close()
    sampler.close()
    bus.publish("/camera/top/image_raw", image(clock.advance(MS), 41))
    np.testing.assert_array_equal(sampler.sample(clock.now_ns()).values["observation.images.top"], newest)


def test_ticks_far_behind_the_clock_still_keep_no_more_than_the_queues_hold(contract: Contract) -> None:
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus)
    for k in range(100):
        bus.publish("/camera/top/image_raw", image(clock.advance(MS), k))
        sampler.advance(START_NS)
    assert bus.dropped() == {"/camera/top/image_raw": 100 - 32 - 1}


def test_advancing_at_every_tick_loses_nothing(contract: Contract) -> None:
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus)
    for k in range(600):
        bus.publish("/camera/top/image_raw", image(clock.advance(5 * MS), k))
        bus.publish("/joint_states", joint_state(clock.now_ns(), k))
        if k % 6 == 0:
            sampler.advance(clock.now_ns())
    assert bus.dropped() == {}


def test_jumps_are_counted_per_topic(contract: Contract) -> None:
    stamps_s = (5, 6, 2, 3)
    bag = [
        ("/joint_states", joint_state(stamp * 1000 * MS, 1.0), (7 + i) * 1000 * MS) for i, stamp in enumerate(stamps_s)
    ]
    assembler = FrameAssembler(contract)
    assert assembler.resets() == {}
    list(frames(assembler, bag, [20_000 * MS]))
    assert assembler.resets() == {"/joint_states": 1}


def test_messages_that_do_not_fit_are_refused(contract: Contract, make_config: Make) -> None:
    with pytest.raises(ContractError, match=r"images.top: /camera/top/image_raw is a sensor_msgs/msg/Image, got a std"):
        offline(contract, [("/camera/top/image_raw", Float64MultiArray([1.0]), 0)], 1)
    rvl = CompressedImage(Header(0), "16UC1; compressedDepth rvl", np.zeros(40, np.uint8))
    with pytest.raises(ContractError, match=r"/camera/top/image_raw.*'16UC1; compressedDepth rvl'"):
        offline(contract, [("/camera/top/image_raw", rvl, 0)], 1)
    without = JointState(Header(0), ARM, np.zeros(5))
    with pytest.raises(ContractError, match=r"observation.state: /joint_states: the message has no joint 'gripper'"):
        offline(contract, [("/joint_states", without, 0)], 1)
    spec = ObservationSpec("observation.images.top", peripheral="top")
    whole = Contract.from_config(make_config([spec]))
    small = encode_image(np.zeros((2, 3, 3), np.uint8), "rgb8", Header(0))
    with pytest.raises(ContractError, match=r"gives \(2, 3, 3\), the contract says \(4, 6, 3\)"):
        offline(whole, [("/camera/top/image_raw", small, 0)], 1)


def test_history_is_the_ticks_just_before(contract: Contract) -> None:
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus, ["observation.state"], history=2)
    step, t_ns = contract.step_ns, START_NS

    def publish(value: float) -> None:
        bus.publish("/joint_states", joint_state(clock.advance(1), value))

    def tick(value: float | None, *, ask: bool = True) -> Frame | None:
        """A joint state, and a tick a little after it; none with the value None."""
        nonlocal t_ns
        if value is not None:
            publish(value)
        t_ns = clock.advance(step - (clock.now_ns() - START_NS) % step)
        if ask:
            return sampler.sample(t_ns)
        sampler.advance(t_ns)
        return None

    def seen(frame: Frame | None) -> list[float]:
        assert frame is not None
        assert [each.stamp_ns for each in frame.history] == [t_ns - k * step for k in range(len(frame.history), 0, -1)]
        return [float(each.values["observation.state"][5]) for each in (*frame.history, frame)]

    first = tick(None)
    assert first is not None
    assert first.missing  # nothing was measured yet
    assert seen(tick(1)) == [1]
    assert seen(tick(2)) == [1, 2]
    tick(3, ask=False)
    assert seen(tick(4)) == [2, 3, 4]
    assert seen(sampler.sample(t_ns)) == [2, 3, 4]  # the same tick again
    publish(5)
    clock.advance(step - 1)  # a tick that nobody asked for
    assert seen(tick(6)) == [4, 5, 6]
    for value in (7, 8, 9):
        publish(value)
        clock.advance(step - 1)
    assert seen(tick(10)) == [8, 9, 10]  # more of them than there is history


def test_history_does_not_reach_over_a_gap(make_config: Make) -> None:
    spec = ObservationSpec("observation.state", topic="/joint_states", align=Align("drop"))
    contract = Contract.from_config(make_config([spec]))
    clock = SteppedClock(START_NS)
    bus = Bus(clock)
    sampler = FrameSampler(contract, bus, history=3)
    lengths = []
    for k in range(8):
        if k != 4:
            bus.publish("/joint_states", joint_state(clock.now_ns() + 1, float(k)))
        frame = sampler.sample(clock.advance(contract.step_ns))
        lengths.append(None if frame.missing else len(frame.history))
    assert lengths == [0, 1, 2, 3, None, 0, 1, 2]


def test_a_foreign_message_without_a_header_needs_to_go_by_receipt(make_config: Make) -> None:
    @attrs.frozen
    class Touch(Message):
        ros_type: ClassVar[str] = "lamp_msgs/msg/Touch"
        hardness: float

    def contract(stamp: str) -> Contract:
        spec = ObservationSpec(
            "observation.touch",
            topic="/touch",
            type=Touch.ros_type,
            foreign=True,
            select=("hardness",),
            align=Align("hold", stamp),
        )
        return Contract.from_config(make_config((spec,)))

    received = [("/touch", Touch(0.5), 7)]
    (frame,) = frames(FrameAssembler(contract("receive")), received, [8])
    np.testing.assert_array_equal(frame.values["observation.touch"], np.array([0.5], np.float32))
    with pytest.raises(ContractError, match=r"a lamp_msgs/msg/Touch has no header; give `align: \{stamp: receive\}`"):
        list(frames(FrameAssembler(contract("header")), received, [8]))
