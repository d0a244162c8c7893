"""Finds the stops of an arm's joints with its own motors: slowly, at low torque, one joint after the other.

It never ran on real servos. A servo's `torque_limit` bounds its torque before it is switched on, and every reading
confirms that the servo still has it. The goal is never more than `_LEASH` ticks ahead of the joint, so a servo whose
host dies stops by itself. A place where the joint stands still under the whole torque counts as its stop only if the
joint comes to the same place with less torque: a cable, a hand or the arm's weight gives way.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import Enum

import attrs
import numpy as np
from ibrobot_terminal import Guide
from ibrobot_terminal.plural import counted
from ibrobot_terminal.questions import Declined

from ibrobot_core.api import CalibrationError, HardwareError
from ibrobot_feetech.arm import hold, relax, write_eprom
from ibrobot_feetech.bus import FeetechBus
from ibrobot_feetech.commands.joints import Joint
from ibrobot_feetech.commands.ranges import Range, doubtful, homing_offset
from ibrobot_feetech.errors import FeetechError, NoReply
from ibrobot_feetech.protocol import faults
from ibrobot_feetech.supply import check_supply, supply
from ibrobot_feetech.sync import SyncReader
from ibrobot_feetech.ticks import MIDDLE_TICK, TICKS_PER_RADIAN, TICKS_PER_TURN

UNTRIED = (
    "Finding the stops by motor was tried on the emulator alone, never on real servos. Keep a hand on the power "
    "switch, clear the arm's surroundings, and stay clear of the arm."
)
TORQUE = 0.4
"""Default share of the stall torque: an SO-101 at 12 V needs 0.31 to hold its weight stretched out, and friction."""
_GENTLE = 0.7
"""Share of the stated torque with which each stop is found again."""
_SAME = 20
"""How far apart both places may be [ticks]: 1.8 degrees."""
_SPEED = 400
"""[ticks/s], 35 degrees/s."""
_ACCELERATION = 20
"""[100 ticks/s^2]"""
_LEASH = 200
"""How far the goal is ahead of the joint [ticks]."""
_BACK = 100
"""How far the joint backs off between both attempts [ticks]."""
_STALLED_S, _STALLED = 0.35, 3
"""A joint that moves by no more than so many ticks in this time stands still."""
_PUSHES = 0.85
"""Share of the torque above which a standing joint pushes with all of it."""
_IDLE_S = 2.0
"""A joint that stands still for so long without pushing does not obey."""
_ARRIVED, _NEARER = 10, 5
"""A joint is at a position within so many ticks, and on its way there if it comes nearer by so many in `_IDLE_S`."""
_OTHERS = 170
"""How far a joint that should hold its position may move [ticks]: 15 degrees, since a soft servo sags."""
_SETTLES_S = 1.0
"""Time in which joints settle after the torque came on."""
_LONGEST_S = 300.0
"""Longest time for the stops of one joint, where nobody is asked [s]."""
_LOST = 5
"""Readings in a row that a servo may miss."""
_SHORT, _LONG = 0.05, 0.25
"""By which share a range may be shorter and longer than the joint's limits."""
_MARGIN = 20
"""Nearest goal to the ends of the turn [ticks]."""
_HOTTEST = 55
"""[deg C]"""
_LOWEST_VOLTAGE = 0.85
"""Share of the first voltage."""
_STALL_A = 2.7
"""Current of an STS3215 that stands still at full torque [A]."""
_SURGES = 3
"""Readings in a row with a greater current than the torque needs, from which the arm is stopped."""
_NUDGE = 60
"""Small motion that shows a person which joint is which [ticks]."""
_CLEAR_LOAD = 25
"""Mean load of both directions that surely is the weight [0.1 %]."""
GRAVITY: Mapping[str, int] = {"shoulder_lift": 1, "elbow_flex": 1, "wrist_flex": 1}
"""Joint of an SO-101 -> sign of the torque of its weight in the middle pose, of an arm that stands upright."""
_ORDER = ("gripper", "wrist_roll", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan")
"""From the gripper to the base: joints that carry most move last, with the others in the middle pose."""
_STANCES: Mapping[str, Mapping[str, float]] = {
    "elbow_flex": {"shoulder_lift": -0.4, "wrist_flex": -1.6},
    "shoulder_lift": {"elbow_flex": -1.6},
}
"""Joint of an SO-101 -> where other joints stand meanwhile, from the middle pose [rad].

In its simulation no link touches another one or the table then, except in the last 5 % of elbow_flex.
"""
_STAND_OFF = 60
"""Least distance of these from a stop [ticks]."""
_SAVED_RAM = ("torque_limit", "goal_velocity", "acceleration")
_SAVED_EPROM = ("homing_offset", "min_position_limit", "max_position_limit")
_COLUMNS = (">id", "joint", "", ">min", ">now", ">max", ">load %", ">A", ">°C", ">V")

type _Steps[T] = Generator[None, None, T]
"""Work that yields once per reading of the servos."""


class _Finished(Exception):
    """Ends a wait for the operator, since the motion is done."""


class Way(Enum):
    """A direction of motion, in ticks."""

    DOWN = -1
    UP = 1


@attrs.frozen
class _State:
    """A reading of one servo."""

    position: int
    speed: int
    load: int
    """[0.1 %], signed."""
    volts: float
    celsius: int
    amperes: float


class StopFinder:
    """Finds the stops of one arm, which stands in its middle pose with its torque off.

    Use it within `restoring`, and call `begin` before `run`.

    Args:
        bus: an open bus.
        guide: the operator.
        joints: the arm's joints.
        measured: those whose stops are found; the others can make a full turn.
        compared: joints whose range is compared with their limits.
        zero_at: position of 0 rad, one of `calibration.ZERO_AT`.
        torque: share of the stall torque that no servo exceeds.
        asks: whether a person says, before a joint is measured, that it is the one that moves.
        signs: whether a person says which direction is positive.
        clock: the time [s].
    """

    def __init__(
        self, bus: FeetechBus, guide: Guide, joints: Sequence[Joint], *, measured: Sequence[Joint],
        compared: Sequence[str], zero_at: str = "pose", torque: float = TORQUE, asks: bool = True, signs: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._bus, self._guide, self._joints, self._clock = bus, guide, list(joints), clock
        self._measured, self._compared, self._zero_at = list(measured), compared, zero_at
        self._torque, self._asks, self._signs = torque, asks, signs
        self._ids = [joint.servo for joint in joints]
        self._limit = round(1000 * torque)
        self._limits = dict.fromkeys(self._ids, self._limit)
        """Servo -> the torque limit that it has."""
        self._ranges: dict[int, Range] = {}
        self._now: dict[int, _State] = {}
        self._missed = dict.fromkeys(self._ids, 0)
        self._held: dict[int, int] = {}
        """Servo -> where it should be, for all that do not move."""
        self._active: int | None = None
        self._loads: dict[int, list[tuple[int, int, int]]] = {servo: [] for servo in self._ids}
        """Servo -> position, load and direction, while it moves."""
        self._inverted: dict[str, bool] = {}
        self._over = dict.fromkeys(self._ids, 0)
        """Servo -> readings in a row with too much current."""
        self._volts: dict[int, float] = {}
        self._begun = False
        self.unrestored: list[str] = []
        """Why servos could not be restored."""

    @contextmanager
    def restoring(self) -> Iterator[None]:
        """Give the servos back all registers and the torque that they have now, at any end.

        Raises:
            FeetechError: if a servo does not answer.
        """
        names = (*_SAVED_EPROM, *_SAVED_RAM, "torque_enable")
        saved = {servo: {name: self._bus.read(servo, name) for name in names} for servo in self._ids}
        try:
            yield
        finally:
            self._restore(saved)

    def begin(self, offsets: Mapping[int, int]) -> None:
        """Prepare the servos, whose torque is off, with temporary offsets and limits.

        Raises:
            HardwareError: if a servo is short of voltage, or does not accept a register.
        """
        bus = self._bus
        reader = self._reader = SyncReader(bus, self._ids, "torque_enable", "present_current")
        self._columns = {name: i for i, name in enumerate(reader.registers)}
        for servo in self._ids:
            check_supply(bus, servo)
            self._volts[servo] = supply(bus, servo).measured
        self._begun = True
        for servo in self._ids:
            whole = {"min_position_limit": 0, "max_position_limit": TICKS_PER_TURN - 1}
            write_eprom(bus, servo, {"homing_offset": offsets[servo], **whole})
            for name, value in (
                ("torque_limit", self._limit),
                ("goal_velocity", _SPEED),
                ("acceleration", _ACCELERATION),
            ):
                bus.write(servo, name, value)

    def run(self) -> tuple[dict[str, Range], dict[str, bool]]:
        """Find the stops; joint -> its range, and joint -> whether its angle decreases as ticks increase.

        Raises:
            CalibrationError: if what was found cannot be the joint's range.
            Declined: if the operator stops it.
            HardwareError: if a servo does not answer or obey, or is not well.
        """
        for servo in self._ids:
            hold(self._bus, servo)
        self._do("The joints hold the pose. Ending this stops the arm.", self._settle())
        inverted = self._inverted
        for joint in sorted(self._joints, key=_place_of):
            if self._asks:
                inverted[joint.name] = self._introduced(joint)
            if joint not in self._measured:
                continue
            stance = self._stance(joint)
            self._do(f"{joint.name} finds its stops. Ending this stops the arm.", self._measure(joint, stance))
            if reversed_ := self._against_gravity(joint, inverted.get(joint.name, False)):
                if not self._signs:
                    raise CalibrationError(reversed_)
                self._guide.say(f"warning: {reversed_}", warning=True)
        return {joint.name: self._ranges[joint.servo] for joint in self._measured}, inverted

    # The operator.

    def _do(self, what: str, steps: _Steps[None]) -> None:
        """Move, with a table and a way to stop for the operator."""

        def rows() -> list[tuple[str, ...]]:
            if self._look():
                try:
                    next(steps)
                except StopIteration:
                    raise _Finished from None
            return self._rows()

        until_s = self._clock() + _LONGEST_S
        try:
            self._guide.wait(
                what, flag="--yes", columns=_COLUMNS, rows=rows, seconds=None if self._asks else _LONGEST_S
            )
        except _Finished:
            return
        if not self._asks and self._clock() >= until_s:
            raise HardwareError(f"{what} It is not done after {_LONGEST_S:.0f} s; free the arm, and begin again")
        self._guide.say("stopped by the operator", warning=True)
        raise Declined

    def _introduced(self, joint: Joint) -> bool:
        """Move a joint a little; returns whether the person says that it turned in its negative direction."""
        self._do(f"{joint.name} moves a little, there and back. Ending this stops the arm.", self._nudge(joint))
        if not self._guide.confirm(f"Did {joint.name} move, and no other joint?", flag="--yes", default=True):
            raise CalibrationError(
                f"{joint.name}: another joint moved: servo {joint.servo} is not its servo; `ibrobot feetech "
                f"setup-motors --joint {joint.name}` sets the id of the right one"
            )
        if not self._signs:
            return False
        question = f"Did {joint.name} move first in its positive direction?"
        return not self._guide.confirm(question, flag="no --check-signs", default=True)

    def _rows(self) -> list[tuple[str, ...]]:
        made: list[tuple[str, ...]] = []
        for joint in self._joints:
            servo, state = joint.servo, self._now.get(joint.servo)
            span = self._ranges.get(servo)
            ends = (str(span.least), str(span.greatest)) if span is not None else ("", "")
            what = "moves" if servo == self._active else ""
            if state is None:
                made.append((str(servo), joint.name, what, ends[0], "", ends[1], "", "", "", ""))
                continue
            made.append((
                str(servo), joint.name, what, ends[0], str(state.position), ends[1], f"{state.load / 10:.0f}",
                f"{state.amperes:.2f}", str(state.celsius), f"{state.volts:.1f}",
            ))  # fmt: skip
        return made

    # The servos.

    def _look(self) -> bool:
        """Read all servos, and refuse whatever is not as it should be; returns whether all answered."""
        replies = self._reader.read()
        values, columns = replies.values, self._columns
        for row, servo in enumerate(self._ids):
            self._missed[servo] = 0 if replies.answered[row] else self._missed[servo] + 1
            if self._missed[servo] > _LOST:
                raise NoReply(self._bus.place(servo), f"no valid reply for {counted(self._missed[servo], 'reading')}")
            if not replies.answered[row]:
                continue
            place = self._bus.place(servo)
            each = {name: int(values[row, column]) for name, column in columns.items()}
            if code := int(replies.errors[row]) | each["status"]:
                raise HardwareError(
                    f"{place}: the servo reports {', '.join(faults(code))}; let it cool, free the joint"
                )
            if each["torque_enable"] != 1 or each["torque_limit"] != self._limits[servo]:
                raise HardwareError(
                    f"{place}: its torque went off or its limit is {each['torque_limit'] / 10:.0f} % where "
                    f"{self._limits[servo] / 10:.0f} % was set, as after a loss of power (brown-out); check the supply "
                    "and the servo's cable"
                )
            state = self._now[servo] = _State(
                each["present_position"], each["present_velocity"], each["present_load"], each["present_voltage"] * 0.1,
                each["present_temperature"], each["present_current"] * 0.0065,
            )  # fmt: skip
            self._check(servo, state)
        return bool(replies.answered.all())

    def _check(self, servo: int, state: _State) -> None:
        place = self._bus.place(servo)
        if state.celsius > _HOTTEST:
            raise HardwareError(f"{place}: it is at {state.celsius} deg C, above {_HOTTEST}; let it cool")
        if state.volts < _LOWEST_VOLTAGE * self._volts[servo]:
            raise HardwareError(
                f"{place}: its supply fell from {self._volts[servo]:.1f} to {state.volts:.1f} V, below "
                f"{100 * _LOWEST_VOLTAGE:.0f} %; check the supply, its plug, and whether it is strong enough for "
                "all servos"
            )
        most = 1.5 * self._torque * _STALL_A
        if abs(state.amperes) > most:
            self._over[servo] += 1
        else:
            self._over[servo] = 0
        if self._over[servo] >= _SURGES:
            raise HardwareError(
                f"{place}: its current is {abs(state.amperes):.2f} A, above {most:.2f} A, which this torque needs at "
                "most; check whether it is an STS3215, and whether its gears turn freely"
            )
        if servo in self._held and servo != self._active and abs(state.position - self._held[servo]) > _OTHERS:
            raise HardwareError(
                f"{place}: it moved from {self._held[servo]} to {state.position} ticks, by more than {_OTHERS}, while "
                "it should stand still: a person or a thing moves it, or its weight is more than the torque of "
                f"{100 * self._torque:.0f} % holds; leave the arm alone, or give more by --torque"
            )

    def _restore(self, saved: Mapping[int, Mapping[str, int]]) -> None:
        """Restore every servo, also if one fails or the operator presses Ctrl-C again."""
        failed = self.unrestored
        interrupted: KeyboardInterrupt | None = None
        left = list(saved)
        while left:
            try:
                if len(left) == len(saved):
                    with suppress(FeetechError):
                        relax(self._bus, self._ids)
                while left:
                    try:
                        self._restore_one(left[0], saved[left[0]])
                    except FeetechError as error:
                        numbers = ", ".join(f"{name} {saved[left[0]][name]}" for name in _SAVED_EPROM)
                        failed.append(f"{error} (it had {numbers})")
                    left.pop(0)
            except KeyboardInterrupt as error:
                interrupted = error
        for text in failed:
            self._guide.say(f"error: not restored: {text}", warning=True)
        if failed:
            self._guide.say(
                "The torque of these servos may be on: cut the power. Afterwards `ibrobot feetech check` with --write "
                "writes their calibration again.",
                warning=True,
            )
        if interrupted is not None:
            raise interrupted

    def _restore_one(self, servo: int, values: Mapping[str, int]) -> None:
        if self._begun:
            write_eprom(self._bus, servo, {name: values[name] for name in _SAVED_EPROM})
            for name in _SAVED_RAM:
                self._bus.write(servo, name, values[name], faulty=True)
        if values["torque_enable"]:
            hold(self._bus, servo)

    def _set_limit(self, servo: int, limit: int) -> None:
        self._bus.write(servo, "torque_limit", limit)
        self._limits[servo] = limit

    # The motions.

    def _settle(self) -> _Steps[None]:
        until_s = self._clock() + _SETTLES_S
        while self._clock() < until_s:
            yield
        self._held = {servo: state.position for servo, state in self._now.items()}
        for joint in self._joints:
            if abs(self._held[joint.servo] - MIDDLE_TICK) > _OTHERS:
                raise CalibrationError(
                    f"{joint.name}: it sagged by {_deg(self._held[joint.servo] - MIDDLE_TICK):.0f} deg as the torque "
                    f"came on, more than {_deg(_OTHERS):.0f}: its weight is more than {100 * self._torque:.0f} % hold, "
                    "or a person holds it; fold the arm, or give more by --torque"
                )

    def _nudge(self, joint: Joint) -> _Steps[None]:
        begin = self._now[joint.servo].position
        yield from self._moved(joint, begin + _NUDGE)
        yield from self._moved(joint, begin)

    def _stance(self, joint: Joint) -> dict[Joint, int]:
        """Joint -> where it stands while another one is measured [ticks]."""
        wanted = _STANCES.get(_plain(joint.name), {})
        stance = {}
        for other in self._joints:
            if (angle := wanted.get(_plain(other.name))) is not None:
                goal = MIDDLE_TICK + round(angle * TICKS_PER_RADIAN) * (-1 if self._inverted.get(other.name) else 1)
                if span := self._ranges.get(other.servo):
                    goal = min(max(goal, span.least + _STAND_OFF), span.greatest - _STAND_OFF)
                stance[other] = goal
        return stance

    def _measure(self, joint: Joint, stance: Mapping[Joint, int]) -> _Steps[None]:
        for other, goal in stance.items():
            yield from self._moved(other, goal)
        servo = self._active = joint.servo
        low = yield from self._stop(joint, Way.DOWN)
        high = yield from self._stop(joint, Way.UP)
        between = self._ranges[servo] = Range(low, low, high)
        if joint.name in self._compared:
            fault = misfit(joint, between, self._torque) or doubtful(joint, between, self._zero_at)
            if fault:
                raise CalibrationError(fault)
        for each in (joint, *stance):
            yield from self._moved(each, MIDDLE_TICK)

    def _moved(self, joint: Joint, goal: int) -> _Steps[None]:
        """Move a joint, and leave it there."""
        self._active = joint.servo
        yield from self._go(joint, goal)
        self._rest(joint)

    def _rest(self, joint: Joint) -> None:
        self._active = None
        self._held[joint.servo] = self._now[joint.servo].position

    def _stop(self, joint: Joint, way: Way) -> _Steps[int]:
        """Find a stop twice, the second time with less torque; returns its place [ticks]."""
        firm = yield from self._push(joint, way)
        yield from self._go(joint, firm - way.value * _BACK)
        self._set_limit(joint.servo, round(_GENTLE * self._limit))
        gentle = yield from self._push(joint, way)
        self._set_limit(joint.servo, self._limit)
        if abs(firm - gentle) > _SAME:
            raise CalibrationError(
                f"{joint.name}: with {100 * self._torque:.0f} % of the torque it stops at {firm}, with "
                f"{100 * _GENTLE * self._torque:.0f} % at {gentle}, {abs(firm - gentle)} ticks apart, more than "
                f"{_SAME}: that is no stop but a cable, a hand, stiff gears or the arm's weight; free the joint, or "
                "give more by --torque"
            )
        return gentle

    def _push(self, joint: Joint, way: Way) -> _Steps[int]:
        """Move until the joint stands still under its torque; returns where [ticks]."""
        servo, sign = joint.servo, way.value
        begin = self._now[servo].position
        # At the other stop, the joint pushes until the servo's own profile has turned round.
        until_s = self._clock() + _IDLE_S
        self._bus.write(servo, "goal_position", begin)
        while abs(self._now[servo].load) > self._limits[servo] / 2 and self._clock() < until_s:
            yield
        recent: deque[tuple[float, int]] = deque()
        most = (1 + _LONG) * (joint.upper - joint.lower) * TICKS_PER_RADIAN
        moved_s = self._clock()
        while True:
            state, now_s = self._now[servo], self._clock()
            if abs(state.speed) > _SPEED / 4:
                self._loads[servo].append((state.position, state.load, sign))
            recent.append((now_s, state.position))
            while len(recent) > 2 and now_s - recent[1][0] >= _STALLED_S:
                recent.popleft()
            places = [position for _, position in recent]
            stands = now_s - recent[0][0] >= _STALLED_S and max(places) - min(places) <= _STALLED
            if not stands:
                moved_s = now_s
            elif abs(state.load) >= _PUSHES * self._limits[servo]:
                return int(np.median(places))
            elif now_s - moved_s > _IDLE_S:
                raise CalibrationError(
                    f"{joint.name}: it stands still at {state.position} with a load of {abs(state.load) / 10:.0f} %, "
                    f"and pushes with less than the {self._limits[servo] / 10:.0f} % it may: servo {servo} does not "
                    "obey; `ibrobot feetech check` compares its registers"
                )
            goal = state.position + sign * _LEASH
            goal = max(_MARGIN, min(TICKS_PER_TURN - 1 - _MARGIN, goal))
            near_end = abs(state.position - goal) < _LEASH / 2 and goal in (_MARGIN, TICKS_PER_TURN - 1 - _MARGIN)
            if (joint.name in self._compared and sign * (state.position - begin) > most) or near_end:
                turned = abs(state.position - begin)
                raise CalibrationError(
                    f"{joint.name}: it turned by {_deg(turned):.0f} deg and met no stop, where its limits are "
                    f"{_deg((joint.upper - joint.lower) * TICKS_PER_RADIAN):.0f} deg apart: a stop is missing, the "
                    "joint did not begin in the middle of its range, or it is another joint; if it can make a full "
                    f"turn, give --full-turn {joint.name}"
                )
            self._bus.write(servo, "goal_position", goal)
            yield

    def _go(self, joint: Joint, goal: int) -> _Steps[None]:
        """Move to a position."""
        servo = joint.servo
        nearest, until_s = abs(goal - self._now[servo].position), self._clock() + _IDLE_S
        sign = 1 if goal > self._now[servo].position else -1
        # A soft servo stops short of its goal, where the weight balances it, so the goal leads the joint.
        while sign * (goal - self._now[servo].position) > _ARRIVED:
            state = self._now[servo]
            if (left := abs(goal - state.position)) <= nearest - _NEARER:
                nearest, until_s = left, self._clock() + _IDLE_S
            if abs(state.speed) > _SPEED / 4:
                self._loads[servo].append((state.position, state.load, sign))
            if self._clock() > until_s:
                raise CalibrationError(
                    f"{joint.name}: on its way to {goal} it stands still at {state.position} for {_IDLE_S:.0f} s with "
                    f"{100 * self._torque:.0f} % of the torque: something holds it, or its weight is more than that; "
                    "free the joint, or give more by --torque"
                )
            ahead = state.position + sign * _LEASH
            self._bus.write(servo, "goal_position", max(_MARGIN, min(TICKS_PER_TURN - 1 - _MARGIN, ahead)))
            yield
        self._bus.write(servo, "goal_position", self._now[servo].position)

    def _against_gravity(self, joint: Joint, inverted: bool) -> str | None:
        """The reason why the joint seems to be reversed; None if its weight pulls as it should, or says nothing."""
        expected = GRAVITY.get(_plain(joint.name), 0)
        mean = self._weight(joint.servo)
        if not expected or mean is None:
            return None
        pulls = -1 if mean > 0 else 1
        if pulls == (-expected if inverted else expected):
            return None
        return (
            f"{joint.name}: holding it takes {abs(mean) / 10:.1f} % of the torque, in the direction that its weight "
            "should pull: it is reversed, or the arm does not stand upright; --check-signs asks for the direction of "
            "each joint"
        )

    def _weight(self, servo: int) -> float | None:
        """Mean load of both directions around the middle pose [0.1 %]; None if it is not surely more than nothing."""
        near = [each for each in self._loads[servo] if abs(each[0] - MIDDLE_TICK) < 300]
        up, down = ([load for _, load, sign in near if sign == way.value] for way in (Way.UP, Way.DOWN))
        if len(up) < 3 or len(down) < 3:
            return None
        upwards, downwards = float(np.median(up)), float(np.median(down))
        mean = (upwards + downwards) / 2
        # A servo whose load counts the other way needs a negative one to turn up against friction.
        if upwards < downwards:
            mean = -mean
        return mean if abs(mean) >= _CLEAR_LOAD else None


def misfit(joint: Joint, between: Range, torque: float) -> str | None:
    """The reason why a range that was found is not that of the joint's limits; None if it can be."""
    expected = (joint.upper - joint.lower) * TICKS_PER_RADIAN
    if between.span < (1 - _SHORT) * expected:
        return (
            f"{joint.name}: between both places where it stops are {_deg(between.span):.0f} deg, its limits are "
            f"{_deg(expected):.0f} deg apart, and at least {100 * (1 - _SHORT):.0f} % of that must be free: something "
            f"is in its way (a cable, the table, a hand), or {100 * torque:.0f} % of the torque is too little"
        )
    if between.span > (1 + _LONG) * expected:
        return (
            f"{joint.name}: between its stops are {_deg(between.span):.0f} deg, its limits are {_deg(expected):.0f} "
            f"deg apart, more than {100 * (1 + _LONG):.0f} % of that: a stop is missing, or it is another joint"
        )
    return None


def missing_servos(bus: FeetechBus, joints: Sequence[Joint]) -> None:
    """Check that the servo of every joint answers.

    Raises:
        HardwareError: if one does not; names a servo that answers instead, whose id no joint has.
    """
    wanted = {joint.servo: joint.name for joint in joints}
    answering = bus.scan(one_by_one=False)
    missing = [servo for servo in wanted if servo not in answering]
    strange = [servo for servo in answering if servo not in wanted]
    if not missing:
        return
    servo, joint = missing[0], wanted[missing[0]]
    has = f"; servo {strange[0]} does, and no joint has that id" if strange else ""
    raise HardwareError(
        f"{bus.place(servo)}: it does not answer{has}; check its cable, or give the servo of {joint} its id with "
        f"`ibrobot feetech setup-motors --joint {joint}`"
    )


def offsets_of(bus: FeetechBus, joints: Sequence[Joint]) -> dict[int, int]:
    """Servo id -> the offset with which it reports the middle of the turn in the present pose.

    Raises:
        CalibrationError: if the servo cannot store it.
        HardwareError: if a joint moves.
    """
    encoders: list[dict[int, int]] = []
    for _ in range(2):
        offsets = {joint.servo: bus.read(joint.servo, "homing_offset") for joint in joints}
        reported = bus.sync_read("present_position", list(offsets))
        encoders.append({servo: (each + offsets[servo]) % TICKS_PER_TURN for servo, each in reported.items()})
    for joint in joints:
        first, second = (each[joint.servo] for each in encoders)
        half = TICKS_PER_TURN // 2
        if abs((second - first + half) % TICKS_PER_TURN - half) > 8:
            raise HardwareError(f"{joint.name}: it moves while its torque is off; let the arm rest, and begin again")
    return {joint.servo: homing_offset(joint.name, encoders[1][joint.servo]) for joint in joints}


def _place_of(joint: Joint) -> tuple[int, int]:
    plain = _plain(joint.name)
    # Joints of other arms move from the last one to the first one.
    return (_ORDER.index(plain), 0) if plain in _ORDER else (len(_ORDER), -joint.servo)


def _plain(name: str) -> str:
    """The name without a prefix such as `left_`."""
    return next((each for each in _ORDER if name.endswith(each)), name)


def _deg(ticks: float) -> float:
    return ticks * 360 / TICKS_PER_TURN
