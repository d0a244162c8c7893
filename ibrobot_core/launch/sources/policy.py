"""The command source of an inference mode: its model, and the dispatcher that keeps the plan filled."""

from __future__ import annotations

from collections.abc import Mapping
from types import NoneType
from typing import Any, override

import attrs
import numpy as np

from ibrobot_core.component import Component, SourceWorker, TransportLink
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.errors import wrong_input
from ibrobot_core.inference.client import Chunk, EngineClient, InferenceClient, LockstepClient
from ibrobot_core.interfaces import Engine, ModelContext, Policy, PolicyVectors
from ibrobot_core.interfaces.policy import ACTION
from ibrobot_core.interfaces.run_state import ActingPolicy, DispatchStats
from ibrobot_core.launch.models import check_model
from ibrobot_core.launch.session import Session
from ibrobot_core.messages import MODEL_ANSWERS, Header, ModelAnswer
from ibrobot_core.options import documented, option
from ibrobot_core.robot import Vector
from ibrobot_core.schema import ControlMode, InferenceConfig
from ibrobot_core.services import Service
from ibrobot_core.units import NS_PER_S


@documented
@attrs.frozen
class ToggleSmoothing:
    """A request to `/action_dispatcher/toggle_smoothing`."""

    enabled: bool = option(help="whether chunks are blended, from the next one on")


TOGGLE_SMOOTHING = Service(
    "/action_dispatcher/toggle_smoothing", ToggleSmoothing, NoneType, "Blend chunks, or do not.", alone="enabled"
)
"""The service `/action_dispatcher/toggle_smoothing`."""


class LoadedModel(Component):
    """Creates a policy, compares it with the contract, and loads it, before torque is switched on."""

    def __init__(self, session: Session, inference: InferenceConfig, link: TransportLink | None) -> None:
        model = session.config.models[inference.model]
        where = session.registry.find("engine", inference.type).summary
        self._link = link if inference.uses_transport else None
        needs = (self._link.name,) if self._link is not None else ()
        super().__init__(f"model:{model.name}", f"policy {model.type}, {where}", needs)
        self._session = session
        self._inference = inference
        self._model = model
        self.contract = Contract.from_config(session.config, model.extra_observations)
        self.units: PolicyVectors
        """The conversion of the policy's vectors, once started."""
        self._policy: Policy | None = None
        self._engine: Engine | None = None

    @property
    def policy(self) -> Policy:
        """The policy; loaded if its `infer` runs in this process."""
        assert self._policy is not None
        return self._policy

    @property
    def engine(self) -> Engine:
        """The engine that runs the policy's `infer`; ready."""
        assert self._engine is not None
        return self._engine

    def described(self) -> dict[str, str]:
        """Name and weights of the policy, for recordings."""
        model, engine = self._model, self.engine
        return {
            "model": model.name,
            "type": model.type,
            "fingerprint": self.policy.fingerprint(),
            "weights": engine.stats.weights,
            "execution_mode": engine.stats.mode,
        }

    @override
    def start(self) -> None:
        model, session = self._model, self._session
        with wrong_input():  # no joint has torque yet
            self._policy = policy = session.make("policy", model, model.name)
            if self._inference.weights_here:
                policy.check_weights()
        self.units = check_model(session.config, model, policy.spec, session.log, self._inference.prompt)
        topics = {part.topic for key in policy.spec.observations for part in self.contract.parts(key)}
        session.refuse_absent(f"model {model.name!r}", topics.__contains__)
        transport = self._link.transport if self._link is not None else None
        context = ModelContext(session.config, policy, transport, self._inference.request_timeout, session.finished)
        self._engine = session.make("engine", self._inference, model.name, model=context)
        self.engine.start()

    @override
    def stop(self) -> None:
        if self._engine is not None:
            self._engine.close()
            self._engine = None
        if self._policy is not None:
            self._policy.close()
            self._policy = None


class PolicySource(SourceWorker):
    """Runs the dispatcher on the contract's ticks, with chunks from a model."""

    session: Session
    autonomous = True
    urgent = True

    def __init__(
        self, session: Session, mode: ControlMode, inference: InferenceConfig, model: LoadedModel,
        needs: tuple[str, ...],
    ) -> None:  # fmt: skip
        summary = f"{inference.model} through the dispatcher at {session.config.contract.rate_hz:g} Hz"
        super().__init__(session, mode, summary, (*needs, model.name))
        self._inference = inference
        self._model = model
        self._stats = DispatchStats()

    @override
    def setup(self) -> None:
        policy, engine, contract = self._model.policy, self._model.engine, self._model.contract
        timeout_s = self._inference.request_timeout
        lockstep = self.session.request.lockstep
        self._client: InferenceClient
        self._client = LockstepClient(policy, engine) if lockstep else EngineClient(policy, engine, timeout_s)
        self.on_end.callback(self._client.close)
        self._dispatcher = Dispatcher(
            contract, policy.spec, self.mode.dispatch, self.session.config.robot, self.session.bus, self._client,
            self._send, timeout_s, self._inference.prompt, self._model.units, self._publish, self._measured,
        )  # fmt: skip
        self._stats = self._dispatcher.stats
        self._step_ns = contract.step_ns
        self._columns = self.session.config.robot.indices(contract.action_joints)

    @override
    def described(self) -> Mapping[str, str]:
        return self._model.described()

    @override
    def summary_rows(self) -> list[tuple[str, str]]:
        count = self._stats.unreachable
        return [("unreachable", f"actions: {count}, for which the robot held the one before")] if count else []

    @override
    def facts(self) -> dict[str, Any]:
        return {"unreachable": self._stats.unreachable}

    def toggle_smoothing(self, enabled: bool) -> None:
        """Enable or disable the blending of chunks, from the next chunk on."""
        with self.lock:
            self._dispatcher.toggle_smoothing(enabled)

    @override
    def begin_mode(self, seed: int) -> None:
        model = self._model
        self.session.acting = ActingPolicy(self._dispatcher.stats, model.engine.stats, model.described)
        self._next_ns = self.session.bus.snapshot_ns() + self._step_ns
        self._dispatcher.begin(seed)
        self.session.bus.serve(TOGGLE_SMOOTHING, lambda request: self.toggle_smoothing(request.enabled))

    def suspend(self) -> None:
        """Drop the plan and request none, e.g. while an operator commands the robot; observations are still sampled."""
        with self.lock:
            self._dispatcher.suspend()

    def resume(self, position: Vector) -> None:
        """Request a plan again, which begins at `position` [rad], shape (J,), where the robot is held."""
        with self.lock:
            self._dispatcher.resume(position[self._columns])

    @override
    def end_mode(self) -> None:
        self.session.bus.unserve(TOGGLE_SMOOTHING)
        self._dispatcher.end()
        self.session.acting = None

    @override
    def work(self, timeout_s: float) -> None:
        clock = self.session.clock
        wait_s = min(timeout_s, max(0.0, (self._next_ns - clock.now_ns()) / NS_PER_S)) if self.active else timeout_s
        chunk = self._client.poll(wait_s)
        with self.lock:
            now_ns = self.session.bus.snapshot_ns()
            if chunk is not None:
                self._dispatcher.accept(chunk, now_ns)
            if self.active and now_ns >= self._next_ns:
                behind = (now_ns - self._next_ns) // self._step_ns
                self._dispatcher.tick(self._next_ns + behind * self._step_ns)
                self._next_ns += (behind + 1) * self._step_ns
                # In lockstep the answer has already arrived.
                if self.session.request.lockstep and (chunk := self._client.poll()) is not None:
                    self._dispatcher.accept(chunk, now_ns)

    def _publish(self, chunk: Chunk, now_ns: int, outcome: str) -> None:
        """Publish a request and its answer."""
        names, model = self._model.contract.action_names, self._model
        engine, lockstep = model.engine.stats, self.session.request.lockstep
        actions: Vector = np.empty((0, len(names)))
        if chunk.actions is not None and chunk.actions.shape[1:] == (len(names),):
            actions = model.units.radians(ACTION, chunk.actions)
        took_ms = (0.0, 0.0) if lockstep else (engine.infer_ms, chunk.queued_ns / 1e6)
        self.session.bus.publish(MODEL_ANSWERS, ModelAnswer(
            Header(now_ns), chunk.id, chunk.start_ns, self._inference.model, engine.server, engine.weights,
            self._inference.prompt, outcome, chunk.error, (now_ns - chunk.start_ns) / 1e6, *took_ms,
            self._dispatcher.step_ns, names, actions.ravel(),
        ))  # fmt: skip

    def _measured(self) -> Vector:
        return self.session.measured().position[self._columns]

    def _send(self, start_ns: int, step_ns: int, positions: Vector) -> None:
        self.session.send_plan(start_ns, step_ns, self._model.contract.action_joints, positions)
