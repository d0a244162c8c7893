"""The scripted experts of the scenes; importing this package imports no MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import PolicyDescriptor
from ibrobot_mujoco.experts.options import ExpertOptions, HandoverExpertOptions, SortExpertOptions
from ibrobot_mujoco.gl import check_asked

if TYPE_CHECKING:
    from ibrobot_core.api import Context, Policy


def _expert(
    scene: str,
    task: str,
    summary: str,
    observed: Callable[[Any], int],
    options: type[ExpertOptions] = ExpertOptions,
    type_: str = "",
) -> PolicyDescriptor:
    name = type_ or f"scripted_{scene}"

    def make(given: Any, ctx: Context) -> Policy:
        check_asked()
        from ibrobot_mujoco.experts.expert import ScriptedExpert

        kind = getattr(import_module(f"{__name__}.{scene}"), task)
        return ScriptedExpert(kind, name, given, ctx, observed(given))

    return PolicyDescriptor(
        type=name,
        options=options,
        make=make,
        summary=f"{summary}, by inverse kinematics and the scene's ground truth",
    )


EXPERTS = (
    _expert("pick_cube", "PickTask", "picks the cube and puts it into the bin", lambda _: 10, type_="scripted_pick"),
    _expert("push", "PushTask", "pushes the block onto the goal", lambda _: 10),
    _expert("stack", "StackTask", "puts the cube on the other one", lambda _: 14),
    _expert(
        "handover",
        "HandoverTask",
        "hands the bar from the left arm to the right one",
        lambda _: 7,
        HandoverExpertOptions,
    ),
    _expert("drawer", "DrawerTask", "opens the drawer", lambda _: 6),
    _expert(
        "sort",
        "SortTask",
        "puts each cube into the bin of its colour",
        lambda given: 8 * given.cubes + 6,
        SortExpertOptions,
    ),
)
"""The policies `scripted_pick`, `scripted_push` and so on."""
