"""The command source of planning modes: goals become trajectories for the executors."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Mapping
from types import NoneType
from typing import Any, override

import attrs

from ibrobot_core.api import (
    HardwareError,
    NotSupported,
    PlanCode,
    PlanningError,
    Pose,
    PoseStamped,
    String,
    ns,
    seconds,
)
from ibrobot_core.app import (
    ControlMode,
    GoalRun,
    NoRequest,
    Received,
    RequestLimits,
    Service,
    SourceWorker,
)
from ibrobot_planning.execution.door import door_of
from ibrobot_planning.execution.log_limiter import LogLimiter
from ibrobot_planning.execution.motions import Execution, commanded
from ibrobot_planning.execution.plans import GoalPlans
from ibrobot_planning.execution.requests import (
    Execute,
    GoTo,
    MoveRequest,
    MoveResult,
    MoveToConfiguration,
    MoveToPose,
    Numbered,
    Outcome,
    results_of,
)
from ibrobot_planning.execution.services import PlanningServices
from ibrobot_planning.goals.grammar import Target, check_frame, target
from ibrobot_planning.goals.tool import pose_matrix
from ibrobot_planning.planner import (
    AnyGoal,
    Goal,
    JointGoal,
    OrientationPolicy,
    PlanResult,
    PoseGoal,
    constrains,
)
from ibrobot_planning.world.objects import observed_world

RESULT: Service[Numbered, MoveResult | None] = Service(
    "/planning/result",
    Numbered,
    MoveResult | None,
    "The result of a goal; null while the robot moves.",
    "number",
    reads=True,
)
CANCEL = Service(
    "/planning/cancel", NoRequest, NoneType, "Drop all goals: the robot slows down and holds.", urgent=True
)
GO_TO = Service(
    "/planning/go_to",
    GoTo,
    int,
    "Move to a goal, which replaces the present one; answers with its number.",
    "goal",
    result=RESULT,
    cancel=CANCEL,
)
MOVE_ACTION = Service(
    "/move_action",
    MoveRequest,
    int,
    "Move to the first goal that can be reached; answers with its number.",
    result=RESULT,
    cancel=CANCEL,
)
"""Named like MoveIt's action, as is the next one."""
EXECUTE = Service(
    "/execute_trajectory",
    Execute,
    int,
    "Follow a trajectory that begins where the robot is; answers with its number.",
    limits=RequestLimits(values=60_000),
    result=RESULT,
    cancel=CANCEL,
)
MOVE_TO_POSE = Service(
    "/moveit_gateway/move_to_pose",
    MoveToPose,
    MoveResult,
    "Move the tool to a pose; answers when the motion has ended.",
    ros_type="ibrobot_msgs/srv/MoveToPose",
    cancel=CANCEL,
)
MOVE_TO_CONFIGURATION = Service(
    "/moveit_gateway/move_to_configuration",
    MoveToConfiguration,
    MoveResult,
    "Move joints to positions; answers when the motion has ended.",
    ros_type="ibrobot_msgs/srv/MoveToConfiguration",
    cancel=CANCEL,
)
CMD_POSE = "/cmd_pose"
"""geometry_msgs/msg/PoseStamped or Pose: a goal."""
CMD_GOAL = "/cmd_goal"
"""std_msgs/msg/String: a goal in words, as `--goal`."""
MOTION_STATUS = "/moveit_gateway/motion_status"
"""std_msgs/msg/String: `idle`, `executing`, `succeeded` or `failed`, as in IB-Robot's gateway."""
_STATUS_NS = ns(0.1)
_GLANCE_S = 0.5
_BUSY_S = 0.01
"""Longest wait of a unit of work while the robot moves [s]."""
_ENDED = MoveResult(False, "the mode or the run ended, or control was reset", 0.0, "CANCELLED", PlanCode.PREEMPTED)
_POLICIES: tuple[OrientationPolicy, ...] = ("keep_axis", "arm_plane", "current", "free")


@attrs.define(eq=False)
class _Move:
    """A goal in progress."""

    number: int
    target: Target
    asked: bool = False
    """Whether the run was started with this goal; it ends after all such goals."""
    stops: int = 0
    """Number of emergency stops before it was requested."""
    era: int = 0
    """The era of plans in which it was requested."""
    failures: list[str] = attrs.field(factory=list)
    begun_ns: int | None = None
    planned: PlanResult | None = None
    dropped: str = ""
    """Why it stops early; empty otherwise."""
    blocked: str = ""
    """What is in its way, or why the world cannot be trusted; empty otherwise."""
    blocked_code: PlanCode = PlanCode.MOTION_PLAN_INVALIDATED_BY_ENVIRONMENT_CHANGE
    result: MoveResult | None = None
    ended: threading.Event = attrs.field(factory=threading.Event)


class PlannerSource(SourceWorker):
    """Moves to goals, planned from the robot's present position.

    The goals of the request are reached one after the other, in the mode in which the run begins. A goal from a service
    or a topic replaces all others; its motion blends with the one under way. A motion stops if something blocks it.

    Raises:
        PlanningError: for an invalid goal of the request.
    """

    session: GoalRun

    def __init__(self, session: GoalRun, mode: ControlMode) -> None:
        assert mode.planner is not None
        super().__init__(session, mode, f"planner {mode.planner.type}")
        self._plans = GoalPlans(session, mode)
        self._results = results_of(session)
        self._inbox: queue.SimpleQueue[Mapping[str, Any] | _Move | None] = queue.SimpleQueue()
        """Events of executors; goals that replace others; None to cancel."""
        self._queue: deque[_Move] = deque()
        self._move: _Move | None = None
        self._errors = LogLimiter(session.clock, session.log.error)
        self._drops = LogLimiter(session.clock, session.log.info)
        self._status = ""
        self._status_ns = 0
        self._worker = 0
        self._submitting = threading.Lock()
        """Held while a goal is handed over, so that the last one is of the newest era."""
        self._choosing = threading.Lock()
        """Held while the move under way changes."""
        self._era = 0, 0
        """Numbers of the emergency stops and of the generation that topics of goals were last read in."""
        for goal in session.request.goals if session.state is None else ():
            try:
                self._queue.append(self._new(goal, asked=True))
            except PlanningError as error:
                error.exit_code = 2
                raise
        self._goals = tuple(self._queue)
        """The goals of the request."""
        self._over = False
        self._services: dict[Service[Any, Any], Callable[[Any], Any]] = {
            GO_TO: lambda request: self._submit(request.goal).number,
            RESULT: lambda request: self._results.of(request.number),
            CANCEL: lambda _: self._put(None),
            MOVE_ACTION: self._move_action,
            EXECUTE: self._execute,
            MOVE_TO_POSE: self._move_to_pose,
            MOVE_TO_CONFIGURATION: self._move_to_configuration,
            **PlanningServices(session, mode, self._plans).handlers,
        }

    @override
    def setup(self) -> None:
        planner = self._plans.make()
        self.on_end.callback(planner.close)
        self._execution = Execution(self.session, door_of(self.session))
        self._topics = {
            CMD_POSE: self.session.bus.subscribe(CMD_POSE, 1, PoseStamped, Pose),
            CMD_GOAL: self.session.bus.subscribe(CMD_GOAL, 1, String),
        }
        for subscription in self._topics.values():
            self.on_end.callback(subscription.close)
        self.session.on_goal.append(self._take_event)
        self.on_end.callback(self.session.on_goal.remove, self._take_event)
        self.on_end.callback(self._drop_all)
        planner.load()

    @override
    def begin_mode(self, seed: int) -> None:
        if self._move is not None:
            self._finish(self._move, "EXECUTION_FAILED", PlanCode.CONTROL_FAILED, "control was reset")
        self._drain()
        self._era = self.session.stops, self.session.generation
        self._forget()
        door = door_of(self.session)
        door.planner, door.stops_before = self._plans.planner, self._stop_before
        for service, handler in self._services.items():
            self.session.bus.serve(service, handler)
        self._show("idle")

    @override
    def end_mode(self) -> None:
        door_of(self.session).planner = None
        for service in self._services:
            self.session.bus.unserve(service)
        self._forget()
        if self._move is not None and not self._move.asked:
            self._finish(self._move, "CANCELLED", PlanCode.PREEMPTED, _ENDED.message)

    def _forget(self) -> None:
        """End waiting goals of services: a mode that is entered again must not move to old goals."""
        while not self._inbox.empty():
            item = self._inbox.get()
            if isinstance(item, _Move):
                self._queue.append(item)
        for move in [each for each in self._queue if not each.asked]:
            self._queue.remove(move)
            self._finish(move, "CANCELLED", PlanCode.PREEMPTED, _ENDED.message)

    def _take_event(self, event: Mapping[str, Any]) -> None:
        if self.active:
            self._inbox.put(event)

    @override
    def work(self, timeout_s: float) -> None:
        self._worker = threading.get_ident()
        try:
            timeout_s = timeout_s if self._move is None else min(timeout_s, _BUSY_S)
            items = [self._inbox.get(timeout_s > 0, timeout_s or None)]
            while not self._inbox.empty():
                items.append(self._inbox.get())
        except queue.Empty:
            items = []
        with self.lock:
            wanted = [item for item in items if not isinstance(item, Mapping)]
            for move in filter(None, wanted[:-1]):  # planning each would delay a cancel behind many goals
                self._finish(move, "CANCELLED", PlanCode.PREEMPTED, _replaced(wanted[-1]))
            for item in items:
                if isinstance(item, Mapping):
                    self._advance(item)
                elif item is wanted[-1]:
                    self._replace(item)
            if not self.active:
                return
            self._take_topics()
            if self._move is not None:
                self._following(self._move, self._execution.step)
                self._end_at_rest(self._move)
            if self._move is None and self._queue and door_of(self.session).at_rest and not self._awaits_world():
                self._begin(self._queue.popleft())
            if self._move is not None and self.session.clock.now_ns() - self._status_ns >= _STATUS_NS:
                self._show("executing")

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        if not self._goals:
            return []
        ended = self._ended()
        reached = sum(result.success for _, result in ended)
        failures = [
            ("", f"{text}: {result.code.name}: {result.message}") for text, result in ended if not result.success
        ]
        return [("goals", f"{reached} of {len(self._goals)} reached"), *failures]

    @override
    def facts(self) -> dict[str, Any]:
        goals = [{"goal": text, **attrs.asdict(result), "code": result.code.name} for text, result in self._ended()]
        return {"goals": goals} if self._goals else {}

    def _ended(self) -> list[tuple[str, MoveResult]]:
        """The goals of the request that have ended, with their results."""
        return [(move.target.text, move.result) for move in self._goals if move.result is not None]

    def _new(
        self, goal: str | Goal | Target, velocity_scaling: float = 1.0, *, asked: bool = False, stops: int | None = None
    ) -> _Move:
        """A goal that was checked.

        Args:
            goal: the goal.
            velocity_scaling: fraction of the velocity limits.
            asked: whether the run was started with this goal.
            stops: number of emergency stops when it was requested; None: all so far.

        Raises:
            PlanningError: for an invalid goal, or while the robot is stopped, since a goal must not wait for the reset.
        """
        stops = self.session.stops if stops is None else stops
        parsed = target(goal, self.session.config.robot, velocity_scaling)
        self._plans.check(parsed)
        if self.session.faults:
            raise PlanningError(f"refused before a reset: {self.session.faults[-1]}", PlanCode.CONTROL_FAILED)
        return _Move(self._results.number(), parsed, asked, stops, self._plans.era)

    def _submit(self, goal: str | Goal | Target, velocity_scaling: float = 1.0) -> _Move:
        """Replace all goals by this one."""
        move = self._new(goal, velocity_scaling)
        self._put(move)
        return move

    def _put(self, move: _Move | None) -> None:
        """Have a goal replace all others, or none if it is None; a search for one of them ends at once."""
        with self._submitting:
            self._plans.drop()
            if move is not None:
                move.era = self._plans.era
            self._inbox.put(move)

    def _move_action(self, wanted: MoveRequest) -> int:
        goal = self._plans.any_goal(wanted.goals, commanded(self.session))
        parsed = target(goal, self.session.config.robot, wanted.velocity_scaling)
        return self._submit(attrs.evolve(parsed, acceleration_scaling=wanted.acceleration_scaling)).number

    def _check_time(self, stamp_ns: int) -> None:
        """Refuse a goal that is too old, or in the future, by the time in its header [ns].

        Raises:
            PlanningError: for such a goal.
        """
        if refusal := self.session.clock.refusal(stamp_ns):
            raise PlanningError(refusal, PlanCode.INVALID_GOAL_CONSTRAINTS)

    def _execute(self, request: Execute) -> int:
        self._check_time(request.header.stamp_ns)
        return self._submit(Target("trajectory", trajectory=request.trajectory())).number

    def _move_to_pose(self, wanted: MoveToPose) -> MoveResult:
        return self._wait(lambda: _nearest(wanted.target_pose), wanted.velocity_scaling)

    def _move_to_configuration(self, wanted: MoveToConfiguration) -> MoveResult:
        state = wanted.target_joint_state

        def goal() -> JointGoal:
            self._check_time(state.header.stamp_ns)
            return JointGoal(state.name, state.position)

        return self._wait(goal, wanted.velocity_scaling)

    def _wait(self, goal: Callable[[], Goal], velocity_scaling: float) -> MoveResult:
        """Submit a goal and wait for its end; an invalid goal is REJECTED."""
        if self.session.request.lockstep and threading.get_ident() == self._worker:
            raise NotSupported(
                f"this service waits for the motion: in lockstep call it from another thread, or {GO_TO.name}"
            )
        try:
            move = self._submit(goal(), velocity_scaling or 1.0)
        except PlanningError as error:
            return MoveResult(False, str(error), 0.0, "REJECTED", error.code)
        while not move.ended.wait(_GLANCE_S) and not self._over:
            pass
        return move.result or _ENDED

    def _drain(self) -> None:
        for subscription in self._topics.values():
            subscription.drain()

    def _take_topics(self) -> None:
        """Move to a goal that has come, unless it is older than a stop or a reset, or too old or too new by its time.

        One without a time counts as made when it came, so that one that waited, e.g. for a long plan, is dropped.
        """
        session = self.session
        era, self._era = self._era, (session.stops, session.generation)
        if era != self._era:
            self._drain()
        for topic, subscription in self._topics.items():
            if (received := subscription.get()) is None:
                continue
            try:
                self._replace(self._new(self._goal_in(received), stops=self._era[0]))
            except PlanningError as error:
                self._errors(f"{topic} {error.code.name}", f"{topic}: {error.code.name}: {error}")
                self._show("failed")

    def _goal_in(self, received: Received) -> str | Goal:
        """The goal of a message.

        Raises:
            PlanningError: if its frame or its time is not that of the robot.
        """
        message, stamp_ns = received.message, 0
        if isinstance(message, PoseStamped):
            check_frame(message.header.frame_id)
            stamp_ns, message = message.header.stamp_ns, message.pose
        self._check_time(stamp_ns or received.received_ns)
        if isinstance(message, String):
            return message.data
        assert isinstance(message, Pose), "the bus refuses other types on these topics"
        return _nearest(message)

    def _replace(self, move: _Move | None) -> None:
        """Replace all goals by `move`; None: hold."""
        why = _replaced(move)
        dropped = list(self._queue)
        self._queue.clear()
        if move is not None:
            self._queue.append(move)
        for other in dropped:
            self._finish(other, "CANCELLED", PlanCode.PREEMPTED, why)
        old = self._move
        if old is None or old.dropped or old.blocked:
            return
        # A trajectory from outside begins where the robot stands.
        if move is None or move.target.trajectory is not None or not self._hand_over(old, move):
            old.dropped = why
            self._execution.stop(old.number)

    def _hand_over(self, old: _Move, new: _Move) -> bool:
        """Plan to the next goal while the robot moves; return False if it must stop first."""
        rest = self._execution.brake(new.number, new.stops)
        if rest is None:
            return False
        self._queue.remove(new)
        with self._choosing:
            self._move = new
        self._finish(old, "CANCELLED", PlanCode.PREEMPTED, f"replaced by goal {new.target.text}")
        new.begun_ns = self.session.clock.now_ns()
        self._show("executing")
        try:
            goals, new.planned = self._plans.plan(new.target, rest, era=new.era)
            self._execution.check(goals)
        except PlanningError as error:
            self._execution.stop(new.number)
            self._finish(new, _outcome(error), error.code, str(error))
            return True
        if not new.blocked:
            blends = new.target.constraints is None and not constrains(new.target.tool)
            self._following(new, lambda: self._execution.follow(goals, blends=blends))
        return True

    def _following(self, move: _Move, step: Callable[[], None]) -> None:
        """Go on with a move; if that fails, slow down."""
        try:
            step()
        except (HardwareError, PlanningError) as error:
            move.failures.append(str(error))
            self._execution.stop(move.number)

    def _stop_before(self, goal_id: str, touched: str, code: PlanCode) -> bool:
        """Stop the move under way before what has come into its way; False if the goal is not of such a move."""
        if not self._execution.follows(goal_id):
            return False
        with self._choosing:
            move = self._move
            if move is None:  # e.g. its mode ends: its goals may still go on for a moment
                return False
            if not move.dropped and not move.blocked:
                move.blocked, move.blocked_code = touched, code
                self._execution.stop(move.number)
        return True

    def _awaits_world(self) -> bool:
        """Whether the first message of a cloud may still come, shortly after the start."""
        return observed_world(self.session.bus).is_awaited

    def _begin(self, move: _Move) -> None:
        move.begun_ns = self.session.clock.now_ns()
        self._show("executing")
        try:
            goals, move.planned = self._plans.plan(move.target, commanded(self.session), era=move.era)
            self._execution.check(goals)  # before any of them is sent
            with self._choosing:
                self._move = move
            self._execution.begin(move.number, goals, move.stops)
        except PlanningError as error:
            self._finish(move, _outcome(error), error.code, str(error))
        except HardwareError as error:
            self._finish(move, "EXECUTION_FAILED", PlanCode.CONTROL_FAILED, str(error))

    def _advance(self, event: Mapping[str, Any]) -> None:
        move = self._move
        failed = self._execution.take(event)
        if move is None or failed is None:
            return
        if failed and not move.dropped:
            move.failures.append(failed)
            self._execution.stop(move.number)
        self._end_at_rest(move)

    def _end_at_rest(self, move: _Move) -> None:
        """Report the outcome of a move if its executors have ended."""
        if self._execution.under_way:
            return
        if move.blocked:
            self._finish(move, "EXECUTION_FAILED", move.blocked_code, self._stopped(move))
        elif move.dropped:
            self._finish(move, "CANCELLED", PlanCode.PREEMPTED, move.dropped)
        elif move.failures:
            # A fault of the robot cancels all goals: the fault is the cause.
            why = "; ".join(self.session.faults or move.failures)
            self._finish(move, "EXECUTION_FAILED", PlanCode.CONTROL_FAILED, why)
        else:
            self._finish(move, "SUCCEEDED", PlanCode.SUCCESS, "")

    def _stopped(self, move: _Move) -> str:
        """How a blocked arm came to rest."""
        if move.blocked_code is PlanCode.SENSOR_INFO_STALE:
            return f"stopped: {move.blocked}"
        try:
            touched = self._execution.touched()
        except PlanningError as error:
            return f"stopped: {move.blocked}; the place cannot be checked: {error}"
        if touched:
            return f"stopped too late for an obstacle within the braking distance: {touched}; ahead: {move.blocked}"
        return f"stopped before an obstacle: {move.blocked}"

    def _finish(self, move: _Move, outcome: Outcome, code: PlanCode, message: str) -> None:
        session, success = self.session, outcome == "SUCCEEDED"
        with self._choosing:
            if move is self._move:
                self._move = None
        duration = seconds(session.clock.now_ns() - move.begun_ns) if move.begun_ns is not None else 0.0
        plan = move.planned
        errors = (plan.position_error, plan.orientation_error, plan.fraction, plan.alternative) if plan else ()
        move.result = MoveResult(success, message, duration, outcome, code, *errors)
        self._results.end(move.number, move.result)
        move.ended.set()
        if success:
            session.log.info("goal %s reached", move.target.text)
        elif outcome == "CANCELLED":
            self._drops(f"{move.number}" if move.asked else "", f"goal {move.target.text} dropped: {message}")
        else:
            cause = f"{move.number}" if move.asked else code.name  # what the run was started for is always reported
            self._errors(cause, f"goal {move.target.text} failed: {code.name}: {message}")
        if not success and (move.asked or outcome != "CANCELLED"):
            session.outcome.goals_failed += 1
        self._show("succeeded" if success else "failed")
        all_ended = len(self._ended()) == len(self._goals)
        if self._goals and all_ended and not self._queue and self._move is None:
            session.finish()

    def _show(self, status: str) -> None:
        """Publish the motion status."""
        self._status_ns = self.session.clock.now_ns()
        self.session.bus.publish(MOTION_STATUS, String(status), latched=True)

    def _drop_all(self) -> None:
        """End all goals and the waiting of their callers."""
        self.end()
        self._over = True


def _outcome(error: PlanningError) -> Outcome:
    """How a goal ends for which there is no plan."""
    return "CANCELLED" if error.code is PlanCode.PREEMPTED else "PLANNING_FAILED"


def _replaced(move: _Move | None) -> str:
    """Why goals end when `move` replaces them; None: they are cancelled."""
    return "cancelled" if move is None else f"replaced by goal {move.target.text}"


def _nearest(pose: Pose) -> AnyGoal:
    """A pose with the orientation policies of IB-Robot's gateway, in their order.

    Raises:
        PlanningError: for a pose that is not finite or whose quaternion is not of length 1.
    """
    goals = tuple(PoseGoal(pose, beyond_reach=policy) for policy in _POLICIES)
    pose_matrix(goals[0])
    return AnyGoal(goals)
