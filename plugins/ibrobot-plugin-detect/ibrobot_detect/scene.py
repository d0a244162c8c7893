"""The detector `scene`: objects that the world of the run has, in simulation by ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from ibrobot_kinematics.run_frames import SHAPES

from ibrobot_core.api import PlanningError, SceneObject
from ibrobot_core.app import RunView
from ibrobot_detect.detector import Detection, Detector, Sight, box_of, fits
from ibrobot_detect.options import SceneOptions


class SceneDetector(Detector):
    """Finds objects by their names in the world.

    Args:
        options: none.
        run: the run.
    """

    def __init__(self, options: SceneOptions, run: RunView) -> None:
        self._bus = run.bus

    @override
    def find(self, name: str, sights: Sequence[Sight]) -> Sequence[Detection]:
        if not self._bus.serves(SHAPES):
            raise PlanningError(
                "nothing knows the objects: the robot YAML needs the section `world`, e.g. `world: {scene: true}`"
            )
        things: Sequence[SceneObject] = self._bus.call(SHAPES)
        chosen = fits(name, [each.name for each in things]) if name else [each.name for each in things]
        return [_detected(each, sights) for each in things if each.name in chosen]


def _detected(thing: SceneObject, sights: Sequence[Sight]) -> Detection:
    match thing.shape, thing.size:
        case "sphere", (radius,):
            lengths = (2 * radius,) * 3
        case "cylinder", (radius, height):
            lengths = (2 * radius, 2 * radius, height)
        case "capsule", (radius, height):
            lengths = (2 * radius, 2 * radius, height + 2 * radius)
        case "box", (x, y, z):
            lengths = (x, y, z)
        case _:  # a plane, which is seen everywhere
            return Detection(thing.name, thing.pose)
    boxes = [box_of(sight, thing.pose, [each / 2 for each in lengths]) for sight in sights]
    return Detection(thing.name, thing.pose, lengths, seen=tuple(each for each in boxes if each is not None))
