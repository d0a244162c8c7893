"""Faults to plant, each in three strengths, and the cause that must be named first."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from operator import mul
from typing import Any

import numpy as np

type Pixels = np.ndarray[Any, Any]
type Change = Callable[[str, Pixels, float], Pixels]


def lost(every: int, state: Pixels) -> Pixels:
    """The second joint without a number in some readings, which ones its value decides."""
    found = state.copy()
    if round(1e6 * state[1]) % every == 0:
        found[1] = np.nan
    return found


STRENGTHS = ("mild", "medium", "strong")
TIMES: dict[str, tuple[dict[str, Any], ...]] = {
    "observation_late": ({"state_age_s": 0.09}, {"state_age_s": 0.15}, {"state_age_s": 0.4}),
    "answers_slow": ({"latency_s": 0.6}, {"latency_s": 0.8}, {"latency_s": 1.1}),
    "plan_dry": (
        {"watermark": 8, "latency_s": 0.4}, {"watermark": 5, "latency_s": 0.4}, {"watermark": 1, "latency_s": 0.4},
    ),
    "requests_fail": ({"failing": 0.25}, {"failing": 0.4}, {"failing": 0.7}),
    "ticks_missed": ({"pause": (1.0, 0.1)}, {"pause": (1.0, 0.2)}, {"pause": (1.0, 0.5)}),
    "limits_low": ({"velocity": 0.5}, {"velocity": 0.4}, {"velocity": 0.2}),
    "guard_held": ({"guarded": (0.4, 0.6)}, {"guarded": (0.3, 0.7)}, {"guarded": (0.1, 0.9)}),
    "takeover": ({"takeover": (0.2, 0.5)}, {"takeover": (0.2, 0.6)}, {"takeover": (0.1, 0.9)}),
    "arm_not_following": ({"gain": {0: 0.7}}, {"gain": {0: 0.5}}, {"gain": {0: 0.0}}),
    "smoothing_averages": ({"torn": 0.15}, {"torn": 0.3}, {"torn": 0.6}),
    "readings_missing": tuple({"seen": partial(lost, each)} for each in (13, 5, 1)),
    "stands_still": ({"idle_s": 4.0}, {"idle_s": 6.0}, {"idle_s": 9.0}),
}  # fmt: skip
"""Cause -> what a run is made with, mild, medium and strong; found without a card."""


def of_top(change: Callable[[Pixels], Pixels]) -> Change:
    """A change of the pictures of the camera `top`."""
    return lambda camera, picture, t_s: np.ascontiguousarray(change(picture)) if camera == "top" else picture


def scaled(*factors: float) -> Change:
    """Pictures whose brightness, or whose colours, are scaled."""
    return of_top(lambda picture: np.clip(picture * np.array(factors), 0, 255).astype(np.uint8))


def blurred(times: int) -> Change:
    """Pictures out of focus."""

    def change(picture: Pixels) -> Pixels:
        values = picture.astype(np.float32)
        for _ in range(times):
            around = [np.roll(values, step, axis) for step in (1, -1) for axis in (0, 1)]
            values = ((values + np.sum(around, axis=0)) / 5).astype(np.float32)
        return values.astype(np.uint8)

    return of_top(change)


def covered(share: float) -> Change:
    """Pictures of which something before the lens hides a part."""

    def change(picture: Pixels) -> Pixels:
        hidden = picture.copy()
        hidden[:, : int(share * picture.shape[1])] = (60, 50, 45)
        return hidden

    return of_top(change)


def frozen(seconds: float) -> Change:
    """Pictures that stop at 1.5 s, and go on after some time."""
    last: list[Pixels] = []

    def change(camera: str, picture: Pixels, t_s: float) -> Pixels:
        if camera != "top":
            return picture
        if not last or not 1.5 <= t_s < 1.5 + seconds:
            last[:] = [picture]
        return last[0]

    return change


def _same(options: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """A fault that has no strengths."""
    return options, options, options


def in_order(*order: int) -> Callable[[Pixels], Pixels]:
    """Joints in another order."""
    return lambda state: state[list(order)]


def of_gripper(change: Callable[[float], float]) -> Callable[[Pixels], Pixels]:
    """A change of what the robot reports of its gripper."""
    return lambda state: np.array([*state[:3], change(float(state[3]))])


PICTURES: dict[str, tuple[dict[str, Any], ...]] = {
    "picture_dark": tuple({"picture": scaled(each)} for each in (0.65, 0.5, 0.25)),
    "picture_bright": tuple({"picture": scaled(each)} for each in (1.4, 1.6, 1.9)),
    "picture_blurred": tuple({"picture": blurred(each)} for each in (1, 3, 8)),
    "picture_covered": tuple({"picture": covered(each)} for each in (0.5, 0.6, 1.0)),
    "picture_frozen": tuple({"picture": frozen(each)} for each in (1.2, 2.0, 4.0)),
    "white_balance": tuple({"picture": scaled(*each)} for each in ((1.15, 1, 0.9), (1.3, 1, 0.8), (1.5, 1, 0.6))),
    "bgr": _same({"picture": of_top(lambda picture: picture[..., ::-1])}),
    "picture_flipped": _same({"picture": of_top(lambda picture: picture[::-1, ::-1])}),
    "cameras_exchanged": _same({"exchanged": True}),
    "camera_moved": tuple({"moved": {"top": each}} for each in ((2, 1, 0.0), (5, 2, 0.03), (12, 6, 0.1))),
}
"""Likewise, found with a card of the data, from pictures."""
JOINTS: dict[str, tuple[dict[str, Any], ...]] = {
    "joint_zero": tuple({"zero": {0: each}, "start": (each, 0, 0, 0)} for each in (0.25, 0.35, 0.45)),
    "unseen_start": tuple({"start": (0, each, 0, 0)} for each in (0.25, 0.4, 0.8)),
    "other_units": _same({"seen": lambda state: state * 180 / np.pi}),
    "joint_order": tuple({"seen": in_order(*each)} for each in ((1, 0, 2, 3), (2, 1, 0, 3), (0, 2, 1, 3))),
    "gripper_reversed": _same({"seen": of_gripper(lambda angle: 1.3 - angle)}),
    "gripper_scaled": tuple({"seen": of_gripper(partial(mul, each))} for each in (1.8, 2.5, 3.5)),
    "other_speed": tuple({"speed": each} for each in (1.7, 2.0, 3.0)),
    "other_prompt": tuple(
        {"prompt": each} for each in ("Pick up the cube.", "pick up the blue ball", "wipe the table")
    ),
    "statistics": tuple({"answered": lambda chunk, by=each: by * chunk + 0.25 * by} for each in (1.6, 2.2, 3.0)),
}
"""Likewise, from positions, commands and answers."""
PLANTED = {**TIMES, **PICTURES, **JOINTS}
DEMONSTRATED: dict[str, Any] = {
    "idle_start": {"idle_s": 3.0, "seconds": 9.5},
    "idle_end": {"seconds": 12.0},
    "stall": {"stall": (2.5, 3.0), "seconds": 10.0},
    "jerk": {"shake": 0.05},
    "saturated": {"seen": lambda state: np.minimum(state, (0.3, 9, 9, 9)), "cut": (0, 0.3)},
    "picture_black": {"picture": lambda camera, picture, t_s: picture * (not 2 < t_s < 3)},
    "picture_frozen": {"picture": frozen(3.0)},
    "picture_dark": {"picture": scaled(0.4)},
    "picture_gaps": {"blind": (2.0, 3.5)},
    "gripper_idle": {"shut": True},
    "arm_not_following": {"gain": {0: 0.4}},
    "camera_moved": {"moved": {"top": (5, 2, 0.03)}},
    "unseen_start": {"start": (0, 0.5, 0, 0)},
    "other_prompt": {"prompt": "wipe the table"},
    "other_speed": {"speed": 2.6, "seconds": 4.0},
    "bgr": {"picture": of_top(lambda picture: picture[..., ::-1])},
    "duplicate": {"seed": 3, "seconds": 6.9},
    "not_judged": {"outcome": "unknown"},
}
"""Likewise, in demonstrations; found in comparison with the other episodes."""
