"""Messages of every type survive CDR, which is that of the rosbags library; what does not fit is refused."""

from __future__ import annotations

import contextlib
import re
import typing
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from ibrobot_ros2 import Codec, CodecError, decode, definition, encode, type_hash
from ibrobot_ros2.definitions import standard_types
from ibrobot_sensor_messages.messages import SENSOR_MESSAGES
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from ibrobot_core import api
from ibrobot_core.api import MESSAGE_TYPES, CameraInfo, Header, Image, Imu, Int32, JointState, Message, String

STAMP = st.integers(-(2**31) * 10**9, (2**31 - 1) * 10**9 + 999_999_999)
FIXED = {
    "k": 9,
    "r": 9,
    "p": 12,
    "orientation_covariance": 9,
    "angular_velocity_covariance": 9,
    "linear_acceleration_covariance": 9,
}
RANGES = {
    "std_msgs/msg/Int8": (-(2**7), 2**7 - 1),
    "std_msgs/msg/Int32": (-(2**31), 2**31 - 1),
    "level": (0, 127),
    "is_bigendian": (0, 255),
    "datatype": (0, 255),
    "episode": (-(2**63), 2**63 - 1),
}
UNSIGNED = (0, 2**32 - 1)


type_hash("ibrobot_msgs/msg/AudioBlock")  # from here on it is among the standard types


def definition_of(cls: Any, name: str) -> Any:
    """How a field of a type that plugins define is defined, as rosbags has it."""
    return dict(standard_types().fielddefs[cls.ros_type][1])[name]


def bounds(cls: Any, name: str) -> tuple[int, int]:
    """What an integer field of such a type can hold."""
    info = np.iinfo(definition_of(cls, name)[1][0])
    return int(info.min), int(info.max)


def length_of(cls: Any, name: str) -> int | None:
    """Length of an array of such a type; None if it may vary."""
    kind, (_, length) = definition_of(cls, name)
    return length if kind == Nodetype.ARRAY else None


def of_class(cls: type) -> st.SearchStrategy:
    hints = typing.get_type_hints(cls)
    return st.builds(cls, **{f.name: of_field(cls, f.name, hints[f.name]) for f in attrs.fields(cls)})


def of_field(cls: type, name: str, hint: Any) -> st.SearchStrategy:
    if typing.get_origin(hint) is tuple:
        return st.lists(of_field(cls, name, typing.get_args(hint)[0]), max_size=3).map(tuple)
    if attrs.has(hint):
        return of_class(hint)
    if typing.get_origin(hint) is not None:
        dtype = typing.get_args(hint)[-1]
        dtype = (typing.get_args(dtype) or (dtype,))[0]  # numpy.dtype[…] in older versions of NumPy
        length = FIXED.get(name) if cls in (CameraInfo, Imu) else None
        if cls in SENSOR_MESSAGES:
            length = length_of(cls, name)
        return hnp.arrays(dtype, length if length is not None else st.integers(0, 5))
    if hint is int:
        low, high = RANGES.get(getattr(cls, "ros_type", ""), RANGES.get(name, UNSIGNED))
        if cls in SENSOR_MESSAGES:
            low, high = bounds(cls, name)
        return STAMP if name.endswith("_ns") else st.integers(low, high)
    single = hint is float and cls in SENSOR_MESSAGES and definition_of(cls, name)[1][0] == "float32"
    plain = {
        bool: st.booleans(),
        float: st.floats(allow_nan=False, width=32 if single else 64),
        str: st.text(st.characters(codec="utf-8")),
    }
    return plain[hint]


def same(one, other) -> bool:
    """Equal, and NaN equals NaN."""
    if attrs.has(type(one)):
        return type(one) is type(other) and all(
            same(getattr(one, f.name), getattr(other, f.name)) for f in attrs.fields(type(one))
        )
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return one == other


@pytest.mark.parametrize("name", MESSAGE_TYPES)
def test_every_type_survives(name):
    @settings(max_examples=25, deadline=None)
    @given(of_class(MESSAGE_TYPES[name]), st.binary(max_size=20))
    def check(message, trailing):
        data = bytes(encode(message))
        assert same(decode(name, data), message)
        assert same(decode(name, data + trailing), message)

    check()


def test_the_bytes_are_those_of_rosbags():
    store = get_typestore(Stores.ROS2_JAZZY)
    kind = store.types
    header = kind["std_msgs/msg/Header"](kind["builtin_interfaces/msg/Time"](-2, 500_000_000), "base")
    theirs = kind["sensor_msgs/msg/JointState"](header, ["a", "é"], np.array([1.0, 2.0]), np.array([]), np.array([3.0]))
    ours = JointState(Header(-1_500_000_000, "base"), ("a", "é"), [1.0, 2.0], [], [3.0])
    assert bytes(encode(ours)) == bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/JointState"))


@pytest.mark.parametrize("name", MESSAGE_TYPES)
def test_definitions_define_the_type(name):
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition(name), name))
    assert store.hash_rihs01(name) == type_hash(name)


def test_big_endian_is_read():
    store = get_typestore(Stores.ROS2_JAZZY)
    data = store.serialize_cdr(store.types["std_msgs/msg/Int32"](7), "std_msgs/msg/Int32", little_endian=False)
    assert decode("std_msgs/msg/Int32", data) == Int32(7)


def test_arrays_of_any_layout_are_taken():
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    for data in (pixels, pixels[:, ::-1, :], np.asfortranarray(pixels)):
        image: Any = decode(Image.ros_type, encode(Image(Header(), 2, 4, "rgb8", 12, data)))
        assert np.array_equal(image.data, data.ravel())


def test_unknown_covariance_is_zeros_as_in_ros():
    imu: Any = decode(Imu.ros_type, encode(Imu(Header())))
    assert np.array_equal(imu.orientation_covariance, np.zeros(9))


WRONG = {
    "too large": (Int32(2**31), "std_msgs/msg/Int32: cannot be encoded: .*format requires"),
    "covariance": (Imu(Header(), orientation_covariance=[1.0]), "sensor_msgs/msg/Imu: cannot be encoded: .*length"),
    "not text": (String(typing.cast(str, 5)), "std_msgs/msg/String: cannot be encoded"),
    "no type": (attrs.make_class("Other", [], bases=(Message,))(), "this message type is not defined"),
}


@pytest.mark.parametrize(("message", "reason"), WRONG.values(), ids=WRONG)
def test_what_does_not_fit_is_refused(message, reason):
    with pytest.raises(CodecError, match=reason):
        encode(message)


def test_damage_is_refused():
    data = bytes(encode(String("hello")))
    for wrong in (b"", b"\x00", data[:6], data[:-3], b"\x00\x03" + data[2:], data[:4] + b"\xff\xff\xff\xff" + data[8:]):
        with pytest.raises(CodecError, match=r"std_msgs/msg/String: "):
            decode("std_msgs/msg/String", wrong)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(sorted(MESSAGE_TYPES)), st.binary(max_size=120))
def test_garbage_raises_nothing_else(name, garbage):
    with contextlib.suppress(CodecError):
        decode(name, b"\x00\x01\x00\x00" + garbage)


SEPARATOR = "=" * 80
LAMP = f"""builtin_interfaces/Time since
builtin_interfaces/Duration[] blinks
std_msgs/Header header
float32[2] colour
lamp_msgs/Bulb[] bulbs
string class
{SEPARATOR}
MSG: lamp_msgs/Bulb
string[] marks
bool lit
"""


def lamp_bytes():
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(LAMP, "lamp_msgs/msg/Lamp"))
    kind = store.types
    time, duration = kind["builtin_interfaces/msg/Time"], kind["builtin_interfaces/msg/Duration"]
    lamp = kind["lamp_msgs/msg/Lamp"](
        time(1, 2),
        [duration(0, 5), duration(-1, 0)],
        kind["std_msgs/msg/Header"](time(3, 4), "roof"),
        np.array([0.5, 1.0], np.float32),
        [kind["lamp_msgs/msg/Bulb"](["a", "b"], True)],
        "E27",
    )
    return bytes(store.serialize_cdr(lamp, "lamp_msgs/msg/Lamp"))


def test_a_foreign_type_is_read_by_its_definition():
    codec = Codec({"lamp_msgs/msg/Lamp": LAMP})
    lamp: Any = codec.decode("lamp_msgs/msg/Lamp", lamp_bytes())
    assert issubclass(type(lamp), Message)
    assert lamp.ros_type == "lamp_msgs/msg/Lamp"
    assert lamp.since_ns == 1_000_000_002
    assert lamp.blinks_ns == (5, -1_000_000_000)
    assert lamp.header == Header(3_000_000_004, "roof")
    assert lamp.colour.tolist() == [0.5, 1.0]
    assert (lamp.bulbs[0].marks, lamp.bulbs[0].lit) == (("a", "b"), True)
    assert lamp.class_ == "E27"
    assert lamp == codec.decode("lamp_msgs/msg/Lamp", lamp_bytes())
    assert bytes(codec.encode(lamp)) == lamp_bytes()


def test_a_foreign_type_leaves_the_standard_ones_alone():
    odd = {"std_msgs/msg/String": "string text\nint32 more\n"}
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(odd["std_msgs/msg/String"], "std_msgs/msg/String"))
    data = store.serialize_cdr(store.types["std_msgs/msg/String"]("x", 4), "std_msgs/msg/String")
    found: Any = Codec(odd).decode("std_msgs/msg/String", data)
    assert (type(found) is not String, found.text, found.more) == (True, "x", 4)
    assert decode("std_msgs/msg/String", encode(String("y"))) == String("y")


def test_idl_is_read_too():
    struct = "module lamp_msgs { module msg { struct Dim { double level; }; }; };"
    idl = f"{SEPARATOR}\nIDL: lamp_msgs/msg/Dim\n{struct}"
    codec = Codec({"lamp_msgs/msg/Dim": idl})
    dim: Any = codec.decode("lamp_msgs/msg/Dim", b"\x00\x01\x00\x00" + np.float64(0.5).tobytes())
    assert dim.level == 0.5


@pytest.mark.parametrize("text", ["float64", "x_msgs/Nowhere it\n", "wstring w\n"])
def test_a_definition_that_cannot_be_used_is_reported_when_it_is_needed(text):
    codec = Codec({"odd_msgs/msg/Odd": text})
    assert codec.decode("std_msgs/msg/Int32", encode(Int32(1))) == Int32(1)
    with pytest.raises(CodecError, match=re.escape("odd_msgs/msg/Odd: ")):
        codec.decode("odd_msgs/msg/Odd", b"\x00\x01\x00\x00")


def test_all_parts_of_messages_are_core_classes():
    """A part that core has and the codec does not know of would come as another class."""
    values = [getattr(api, name) for name in api.__all__ if api.home_of(name) == Message.__module__]
    parts = {each for each in values if isinstance(each, type) and attrs.has(each)}
    from ibrobot_ros2.convert import _PARTS

    assert parts - set(MESSAGE_TYPES.values()) - {Message} == set(_PARTS.values())


HEADED = "std_msgs/Header header\n"
WRONG_DEFINITIONS = {
    "none": ("", "has no definition"),
    "only a space": (" \n", "has no definition"),
    "bytes": (b"float32 force", "has no definition"),
    "a field less": (HEADED, "the definition lacks force"),
    "a field more": (f"{HEADED}float32 force\nfloat32 more\n", "the class lacks more"),
    "another name": (f"{HEADED}float32 farce\n", "the class lacks farce; the definition lacks force"),
    "a time": (f"{HEADED}builtin_interfaces/Time force\n", "the class lacks force_ns; the definition lacks force"),
    "itself": (f"{HEADED}skin_msgs/Touch force\n", "contains itself"),
    "each other": (
        f"{HEADED}skin_msgs/A force\n{SEPARATOR}\nMSG: skin_msgs/A\nskin_msgs/B b\n"
        f"{SEPARATOR}\nMSG: skin_msgs/B\nskin_msgs/A a\n",
        "contains itself",
    ),
    "another header": (
        f"{HEADED}float32 force\n{SEPARATOR}\nMSG: std_msgs/Header\nint32 evil\n",
        "has other fields of std_msgs/msg/Header than those that are known",
    ),
    "no type": (f"{HEADED}other_msgs/Thing force\n", "needs 'other_msgs/msg/Thing', which is not defined"),
    "no definition": ("float32", "its definition cannot be read"),
}


@pytest.mark.parametrize("mistake", WRONG_DEFINITIONS)
def test_wrong_definition_of_a_plugin_is_named_before_anything_is_recorded(mistake, monkeypatch):
    """What the definition lacks would be lost, and what it changes would be changed for every other message."""
    text, reason = WRONG_DEFINITIONS[mistake]
    name = f"skin_msgs/msg/Touch{list(WRONG_DEFINITIONS).index(mistake)}"
    text = text.replace("skin_msgs/Touch ", f"skin_msgs/{name.rpartition('/')[2]} ") if isinstance(text, str) else text
    fields = {"header": attrs.field(default=Header()), "force": attrs.field(default=0.5)}
    touch: Any = attrs.make_class(
        "Touch", fields, bases=(Message,), class_body={"ros_type": name, "definition": text}, frozen=True
    )
    monkeypatch.setitem(MESSAGE_TYPES._own, name, touch)
    for _ in range(2):  # the same again: a refused definition leaves nothing behind
        with pytest.raises(CodecError, match=re.escape(reason)):
            encode(touch())
    assert decode("std_msgs/msg/Int32", encode(Int32(3))) == Int32(3)
    assert type_hash("std_msgs/msg/Header") == get_typestore(Stores.ROS2_JAZZY).hash_rihs01("std_msgs/msg/Header")


def test_bag_whose_definition_contains_itself_is_one_error():
    codec = Codec({"odd_msgs/msg/Odd": "odd_msgs/Odd it\n"})
    with pytest.raises(CodecError, match="odd_msgs/msg/Odd: its definition contains itself"):
        codec.decode("odd_msgs/msg/Odd", b"\x00\x01\x00\x00")
