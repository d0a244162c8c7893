"""Messages of the page, whatever a browser sends."""

from __future__ import annotations

import json
import math

from hypothesis import given
from hypothesis import strategies as st
from ibrobot_webxr.exchange import Delays
from ibrobot_webxr.messages import Hands, Press, decode

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
KEYS = ("type", "n", "t", "heading", "hands", "event", "camera")
HAND = {
    "position": [0, 1, 0],
    "orientation": [0, 0, 0, 1],
    "clutch": True,
    "gripper": 0.5,
    "open": 0,
    "move": [0, 0, 1],
}
GOOD = {"type": "hands", "n": 1, "t": 2.5, "heading": 0.1, "hands": {"right": HAND}}


def finite(message: object) -> bool:
    if not isinstance(message, Hands):
        return True
    numbers = [message.time_s, message.heading]
    for hand in message.hands.values():
        numbers += [*hand.orientation, *(hand.position or ()), hand.gripper or 0.0, hand.open, *hand.move]
    return all(math.isfinite(number) for number in numbers)


def check(text: str) -> None:
    """A message is finite, or an error with a text."""
    try:
        message = decode(text)
    except ValueError as error:
        if not str(error):
            raise
    else:
        assert finite(message)


@given(st.text())
def test_any_text_is_a_message_or_an_error(text: str):
    check(text)


@given(st.dictionaries(st.sampled_from(KEYS), VALUES), st.dictionaries(st.sampled_from(tuple(HAND)), VALUES))
def test_any_values_in_a_message_give_finite_poses_or_an_error(changes: dict[str, object], hand: dict[str, object]):
    for text in (json.dumps({**GOOD, **changes}), json.dumps({**GOOD, "hands": {"left": {**HAND, **hand}}})):
        check(text)


def test_a_good_message_keeps_its_values():
    message = decode(json.dumps(GOOD))
    assert isinstance(message, Hands)
    assert (message.number, message.time_s, message.heading) == (1, 2.5, 0.1)
    right = message.hands["right"]
    assert (right.position, right.orientation) == ((0, 1, 0), (0, 0, 0, 1))
    assert (right.clutch, right.gripper, right.move) == (True, 0.5, (0, 0, 1))
    assert decode('{"type": "press", "event": "start"}') == Press("start")


def test_lateness_counts_from_the_quickest_messages_and_follows_drifting_clocks():
    delays = Delays()
    assert delays.late_s(100.0, 500.02) == 0
    assert delays.late_s(100.1, 500.11) == 0
    assert math.isclose(delays.late_s(100.2, 500.26), 0.05, abs_tol=1e-9)
    # The page's clock is slow by 1 ms a second: ten minutes later nothing is late.
    late = [delays.late_s(100.2 + 0.999 * i / 10, 500.21 + i / 10) for i in range(6000)]
    assert max(late) < 0.025
