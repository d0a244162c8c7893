"""Whether the sizes, masses and inertias of a model fit its joints: wrong units of a file make them absurd."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import attrs
import mujoco
import numpy as np

from ibrobot_core.api import HardwareError, Vector

_POSES = 50
_LEAST_REACH = 0.05
"""Distance of joints that is taken for those at one place [m]."""
_LARGE, _ABSURDLY_LARGE = 3.0, 20.0
"""Largest side of a body, in terms of the reach of the joints."""
_SMALL = 0.02
"""Largest side of all bodies, in terms of the reach."""
_DENSE, _LIGHT = 25_000.0, 5.0
"""Densities beyond any material of robots [kg/m^3]."""
_HEAVY_KG = 5_000.0
_GYRATION, _ABSURD_GYRATION = 2.0, 30.0
"""Radius of gyration, in terms of the body's largest side or the reach."""
_ABSURD_EFFORT = 1000.0
"""Torque to hold the weight, in terms of the effort."""
_SLOW_S, _ABSURDLY_SLOW_S = 2.0, 2000.0
"""Time to accelerate to the full speed at full effort [s]."""
_FAST, _FAR_M = 50.0, 10.0
"""Speed [rad/s or m/s], and way of a sliding joint, that no arm has."""
_MM = 'are millimetres meant? A mesh takes scale="0.001 0.001 0.001"'


@attrs.frozen
class Drive:
    """What a joint can do: effort [N m or N] and speed [rad/s or m/s]."""

    joint: str
    effort: float
    velocity: float
    lower: float
    upper: float


def check_plausible(
    model: mujoco.MjModel, drives: Sequence[Drive], carried: tuple[Vector, Vector],
    places: Mapping[str, str],
) -> list[str]:  # fmt: skip
    """What is doubtful about a model, one sentence each.

    Args:
        model: the compiled model.
        drives: its driven joints.
        carried: the weights and inertias that `loads` gives.
        places: body -> file and line, for errors.

    Raises:
        HardwareError: if a size, mass or inertia is absurd.
    """
    reach = max(_reach(model), _LEAST_REACH)
    return [
        *_sizes(model, reach, places),
        *_masses(model, places),
        *_inertias(model, reach, places),
        *_drives(model, drives, *carried),
    ]


def summary(model: mujoco.MjModel) -> str:
    """Mass and reach, for a note."""
    mass = sum(float(model.body_mass[body]) for body in _moving(model))
    return f"The parts that move weigh {mass:.3g} kg, and the joints reach {_reach(model):.2g} m."


def _reach(model: mujoco.MjModel) -> float:
    """Longest way along the frames of bodies from the base [m]."""
    ways = np.zeros(model.nbody)
    for body in range(1, model.nbody):
        ways[body] = ways[model.body_parentid[body]] + np.linalg.norm(model.body_pos[body])
    return float(ways.max())


def _sides(model: mujoco.MjModel, body: int) -> Vector:
    """Sides of the largest shape of a body, sorted; shape (3,)."""
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    boxes = [2 * model.geom_aabb[i, 3:] for i in range(first, first + count)]
    return np.sort(max(boxes, key=lambda each: float(each.max()), default=np.zeros(3)))


def _volume(model: mujoco.MjModel, body: int) -> float:
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    return sum(float(np.prod(2 * model.geom_aabb[i, 3:])) for i in range(first, first + count))


def _sizes(model: mujoco.MjModel, reach: float, places: Mapping[str, str]) -> list[str]:
    doubts, sides = [], [_sides(model, body) for body in range(model.nbody)]
    for body, size in enumerate(sides):
        text = f"{_at(model, body, places)} is {_metres(size)} m, but the joints reach {reach:.2g} m: {_MM}"
        if size[2] > _ABSURDLY_LARGE * reach:
            raise HardwareError(text)
        if size[2] > _LARGE * reach:
            doubts.append(text)
    most = max(float(size[2]) for size in sides)
    if 0 < most < _SMALL * reach:
        doubts.append(
            f"The largest shape is {most:.2g} m, but the joints reach {reach:.2g} m: is the scale of meshes right?"
        )
    return doubts


def _masses(model: mujoco.MjModel, places: Mapping[str, str]) -> list[str]:
    doubts = []
    for body in _moving(model):
        mass, volume = float(model.body_mass[body]), _volume(model, body)
        if mass > _HEAVY_KG:
            raise HardwareError(
                f"{_at(model, body, places)} has a mass of {mass:.3g} kg: are grams or millimetres meant?"
            )
        if volume > 1e-7 and not _LIGHT < mass / volume < _DENSE:
            doubts.append(
                f"{_at(model, body, {})} has {mass:.3g} kg within {_metres(_sides(model, body))} m, "
                f"{mass / volume:.2g} kg/m^3."
            )
    return doubts


def _inertias(model: mujoco.MjModel, reach: float, places: Mapping[str, str]) -> list[str]:
    doubts = []
    for body in _moving(model):
        mass, inertia = float(model.body_mass[body]), float(model.body_inertia[body].max())
        if mass <= 0:
            continue
        radius = (inertia / mass) ** 0.5
        size = float(_sides(model, body)[2])
        text = (
            f"{_at(model, body, places)} has {inertia:.3g} kg m^2 with {mass:.3g} kg, as if its mass were "
            f"{radius:.2g} m from its centre: are kg mm^2 meant?"
        )
        if radius > _ABSURD_GYRATION * max(size, reach):
            raise HardwareError(text)
        if radius > _GYRATION * max(size, 0.1 * reach):
            doubts.append(text)
        if model.body_ipos[body] @ model.body_ipos[body] > (_ABSURDLY_LARGE * max(size, reach)) ** 2:
            away = float(np.linalg.norm(model.body_ipos[body]))
            raise HardwareError(f"{_at(model, body, places)} has its centre of mass {away:.3g} m from its frame: {_MM}")
    return doubts


def _drives(model: mujoco.MjModel, drives: Sequence[Drive], weights: Vector, inertias: Vector) -> list[str]:
    """Whether the drives can hold and accelerate what they move."""
    doubts: list[str] = []
    for drive in drives:
        address = int(model.joint(drive.joint).dofadr[0])
        slides = model.joint(drive.joint).type[0] == mujoco.mjtJoint.mjJNT_SLIDE
        unit, speed = ("N", "m/s") if slides else ("N m", "rad/s")
        weight, seconds = float(weights[address]), drive.velocity * float(inertias[address]) / drive.effort
        held = f"joint {drive.joint} holds up to {weight:.3g} {unit}, but its effort is {drive.effort:.3g} {unit}"
        full = f"its {drive.velocity:.3g} {speed} at {drive.effort:.3g} {unit}"
        slow = f"joint {drive.joint} needs {seconds:.2g} s to {full}"
        if weight > _ABSURD_EFFORT * drive.effort or seconds > _ABSURDLY_SLOW_S:
            fault = held if weight > _ABSURD_EFFORT * drive.effort else slow
            raise HardwareError(f"{fault}: masses, inertias and <limit effort=…> do not fit")
        if weight > drive.effort:
            doubts.append(f"{held}; the simulation holds the weight all the same.")
        if seconds > _SLOW_S:
            doubts.append(f"{slow}.")
        if drive.velocity > _FAST:
            doubts.append(f"joint {drive.joint} has a speed of {drive.velocity:.3g} {speed}.")
        if slides and drive.upper - drive.lower > _FAR_M:
            doubts.append(f"joint {drive.joint} slides {drive.upper - drive.lower:.3g} m: are millimetres meant?")
    return doubts


def loads(model: mujoco.MjModel, ranges: Mapping[str, tuple[float, float]]) -> tuple[Vector, Vector]:
    """Largest weight [N m or N] and inertia that each degree of freedom carries in some poses; each has shape (nv,).

    Args:
        model: the model.
        ranges: joint -> lower and upper limit.
    """
    data = mujoco.MjData(model)
    generator = np.random.default_rng(0)
    weights, inertias = np.zeros(model.nv), np.zeros(model.nv)
    for _ in range(_POSES):
        for joint, (lower, upper) in ranges.items():
            data.joint(joint).qpos = generator.uniform(lower, upper)
        mujoco.mj_forward(model, data)
        weights = np.maximum(weights, np.abs(data.qfrc_bias))  # at rest, it is the weight alone
        for i, unit in enumerate(np.eye(model.nv)):
            moved = np.zeros(model.nv)
            mujoco.mj_mulM(model, data, moved, unit)
            inertias[i] = max(inertias[i], moved[i])
    return weights, inertias


def _moving(model: mujoco.MjModel) -> list[int]:
    return [body for body in range(1, model.nbody) if model.body_weldid[body]]


def _at(model: mujoco.MjModel, body: int, places: Mapping[str, str]) -> str:
    name = model.body(body).name
    return f"{places[name]}: link {name!r}" if name in places else f"link {name}"


def _metres(size: Vector) -> str:
    return " x ".join(f"{each:.3g}" for each in size[::-1])
