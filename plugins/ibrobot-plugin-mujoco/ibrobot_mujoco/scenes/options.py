"""Options of the scenes; listing plugins does not import MuJoCo."""

from __future__ import annotations

from typing import Any

import attrs

from ibrobot_core.api import Options, documented, option
from ibrobot_mujoco.spans import Range, Span, ordered, span

_TURN = 3.14159


@documented
@attrs.frozen(kw_only=True)
class SceneOptions(Options):
    """Options of every scene. Each episode draws from a range `[lowest, highest]`; a number fixes the value."""

    friction: Span = span(1.0, ge=0.05, le=3.0, help="sliding friction of objects, table and jaws, relative to 1")
    light: Span = span(1.0, ge=0.0, le=3.0, help="brightness of all lamps, relative to the usual one")
    camera_shift: Span = span(
        0.0, unit="m", ge=-0.2, le=0.2, help="shift of the fixed cameras along x, y and z, each drawn by itself"
    )
    camera_turn: Span = span(
        0.0, unit="rad", ge=-0.5, le=0.5, help="turn of the fixed cameras about x, y and z, each drawn by itself"
    )
    distractors: int = option(0, ge=0, le=8, help="number of further objects that lie around")


def _cube_size(default: float = 0.025) -> Any:
    return span(default, unit="m", ge=0.005, le=0.1, help="edge of a cube")


def _distance(default: Range, what: str = "cube") -> Any:
    return option(default, unit="m", validator=ordered, help=f"distance of the {what} from the base's origin")


def _bearing(default: Range, what: str = "cube") -> Any:
    return option(default, unit="rad", validator=ordered, help=f"direction of the {what}; 0 is ahead")


def _yaw(what: str = "cube") -> Any:
    return option((-_TURN, _TURN), unit="rad", validator=ordered, help=f"rotation of the {what}")


def _colour(default: Span, what: str = "cube") -> Any:
    return span(default, ge=0.0, le=1.0, help=f"hue of the {what}: 0 red, 1/3 green, 2/3 blue, 1 red")


@documented
@attrs.frozen(kw_only=True)
class PickCubeOptions(SceneOptions):
    """Options of scene `pick_cube`."""

    cube_size: Span = _cube_size()
    cube_colour: Span = _colour(0.0)
    cube_distance: Range = _distance((0.20, 0.27))
    cube_bearing: Range = _bearing((-0.7, 0.5))
    cube_yaw: Range = _yaw()
    bin_position: Range = option((0.10, 0.24), unit="m", help="x and y of the bin's centre")


@documented
@attrs.frozen(kw_only=True)
class StackOptions(SceneOptions):
    """Options of scene `stack`."""

    cube_size: Span = _cube_size()
    cube_colour: Span = _colour(0.0, "cube to stack")
    base_size: Span = _cube_size(0.03)
    base_colour: Span = _colour(0.6, "cube below")
    cube_distance: Range = _distance((0.19, 0.26), "cubes")
    cube_bearing: Range = _bearing((-0.7, 0.7), "cubes")
    cube_yaw: Range = _yaw("cubes")


@documented
@attrs.frozen(kw_only=True)
class PushOptions(SceneOptions):
    """Options of scene `push`."""

    block_size: Span = _cube_size(0.035)
    block_colour: Span = _colour(0.1, "block")
    block_distance: Range = _distance((0.19, 0.22), "block")
    block_bearing: Range = _bearing((-0.5, 0.5), "block")
    block_yaw: Range = _yaw("block")
    goal_distance: Range = _distance((0.26, 0.29), "goal")
    goal_bearing: Range = _bearing((-0.5, 0.5), "goal")
    goal_tolerance: float = option(0.02, unit="m", gt=0, le=0.1, help="distance from the goal that counts as reached")


@documented
@attrs.frozen(kw_only=True)
class DrawerOptions(SceneOptions):
    """Options of scene `drawer`."""

    drawer_colour: Span = _colour(0.08, "drawer")
    handle_distance: Range = _distance((0.24, 0.27), "handle of the closed drawer")
    handle_bearing: Range = _bearing((-0.6, 0.6), "handle")
    drawer_turn: Range = option(
        (-0.2, 0.2), unit="rad", validator=ordered, help="turn of the drawer away from facing the base"
    )
    drawer_damping: Span = span(2.0, unit="N s/m", ge=0.0, le=20.0, help="viscous friction of the drawer")
    opened: float = option(0.08, unit="m", gt=0, le=0.11, help="distance that counts as open")


@documented
@attrs.frozen(kw_only=True)
class HandoverOptions(SceneOptions):
    """Options of scene `handover`. Positions are in the frame between both arms."""

    bar_colour: Span = _colour(0.45, "bar")
    bar_x: Range = option((0.17, 0.23), unit="m", validator=ordered, help="x of the bar's middle")
    bar_y: Range = option((0.03, 0.10), unit="m", validator=ordered, help="y of the bar's middle")
    bar_yaw: Range = option((-0.4, 0.4), unit="rad", validator=ordered, help="turn of the bar away from y")


@documented
@attrs.frozen(kw_only=True)
class SortOptions(SceneOptions):
    """Options of scene `sort`."""

    cubes: int = option(3, ge=1, le=4, help="number of cubes, each red or blue at random")
    cube_size: Span = _cube_size()
    cube_distance: Range = _distance((0.19, 0.27), "cubes")
    cube_bearing: Range = _bearing((-0.6, 0.6), "cubes")
    cube_yaw: Range = _yaw("cubes")
    red_bin: Range = option((0.10, 0.24), unit="m", help="x and y of the red bin's centre")
    blue_bin: Range = option((0.10, -0.24), unit="m", help="x and y of the blue bin's centre")
