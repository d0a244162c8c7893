"""Causes in the model itself, which is asked again."""

from __future__ import annotations

from typing import TYPE_CHECKING, override

from ibrobot_diagnose.cause import Cause, Evidence, ModelCause, likelihood
from ibrobot_diagnose.window import Window

if TYPE_CHECKING:
    from ibrobot_diagnose.ask_again import Examined


class OtherModel(ModelCause):
    """The model does not answer as in the recording."""

    name = "other_model"
    title = "the model answers as in the recording, bit for bit"
    needs = frozenset({"model", "answers"})
    remedy = (
        "Give the checkpoint that acted, and the same library versions; what this model answers says nothing about the "
        "run otherwise."
    )

    @override
    def compare(self, window: Window, model: Examined) -> Evidence | None:
        again = model.again
        if not again:
            return None
        differing = [each for each in again if not each.equal]
        if not differing:
            return None
        worst = max(each.difference for each in again)
        first = differing[0]
        at_s = window.since(first.asked.answer.observed_ns)
        text = (
            f"{len(differing)} of {len(again)} answers differ when the model is asked again, by up to {worst:.2g} rad; "
            "the "
            f"first one is that of {at_s:.2f} s: {model.whose}."
        )
        strength = likelihood(min(worst, 10.0), 0.01, 0.1)
        return Evidence(text, worst, "rad", 0.01, strength, at_s)


class CameraIgnored(ModelCause):
    """The policy does not look at a camera."""

    name = "camera_ignored"
    title = "the policy looks at its cameras"
    needs = frozenset({"model", "pictures"})
    remedy = (
        "Train longer, on more varied starts, or with fewer inputs: a policy that sees the answer in its joints need "
        "not "
        "look. Check that the objects are visible in the pictures in their size for the model."
    )

    @override
    def compare(self, window: Window, model: Examined) -> Evidence | None:
        effects = model.effects
        names = {camera.name for camera in window.cameras.values()}
        of_cameras = {name: [each.largest for each in effects if each.what == name] for name in sorted(names)}
        of_cameras = {name: each for name, each in of_cameras.items() if each}
        largest = max((each.largest for each in effects), default=0.0)
        if not of_cameras or largest <= 0:
            return None
        name = min(of_cameras, key=lambda each: max(of_cameras[each]))
        moved = max(of_cameras[name])
        every = len(of_cameras) > 1 and all(max(each) < 0.01 for each in of_cameras.values())
        ignored = "its pictures, of all cameras" if every else f"the camera {name}"
        text = (
            f"The policy ignores {ignored}: without its picture, or with another one, its answers move by "
            f"{moved:.4f} rad; other changes move them by up to {largest:.2f} rad."
        )
        return Evidence(text, moved, "rad", 0.01, likelihood(moved, 0.01, 0.002))


CAUSES: tuple[type[Cause], ...] = (OtherModel, CameraIgnored)
