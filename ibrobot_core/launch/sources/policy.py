"""Execution: the model of an inference mode, and the dispatcher that keeps the plan filled from it."""

from __future__ import annotations

from typing import override

from ibrobot_core.component import Component
from ibrobot_core.config.schema import ControlMode, InferenceConfig
from ibrobot_core.contract.specs import Contract
from ibrobot_core.dispatch.dispatcher import Dispatcher
from ibrobot_core.errors import PolicyError
from ibrobot_core.inference.client import EngineClient, InferenceClient, LockstepClient
from ibrobot_core.inference.engine import Engine, LocalEngine
from ibrobot_core.inference.policy_units import PolicyInItsUnits
from ibrobot_core.inference.process import ProcessEngine
from ibrobot_core.inference.remote import RemoteEngine
from ibrobot_core.interfaces import PictureCodec, Policy
from ibrobot_core.launch.models import check_model
from ibrobot_core.launch.session import ActingPolicy, Session
from ibrobot_core.launch.sources.source_worker import SourceWorker
from ibrobot_core.launch.transport import TransportLink
from ibrobot_core.robot import Vector
from ibrobot_core.units import NS_PER_S

TOGGLE_SMOOTHING = "/action_dispatcher/toggle_smoothing"


class LoadedModel(Component):
    """Makes a policy, compares it with the contract, and has it loaded where it runs, before anything is powered."""

    def __init__(self, session: Session, inference: InferenceConfig, link: TransportLink | None) -> None:
        model = session.config.models[inference.model]
        distributed = inference.execution_mode == "distributed"
        where = {"monolithic": "", "process": ", in a process of its own", "distributed": ", on a server"}
        summary = f"policy {model.type}{where[inference.execution_mode]}"
        super().__init__(f"model:{model.name}", summary, (link.name,) if distributed and link is not None else ())
        self._link = link
        self._session = session
        self._inference = inference
        self._model = model
        self.contract = Contract.from_config(session.config, model.extra_observations)
        self._policy: Policy | None = None
        self._engine: Engine | None = None

    @property
    def policy(self) -> Policy:
        """The policy; loaded where its `infer` runs here."""
        assert self._policy is not None
        return self._policy

    @property
    def engine(self) -> Engine:
        """Where its `infer` runs, ready."""
        assert self._engine is not None
        return self._engine

    def described(self) -> dict[str, str]:
        """Which policy acts, and with which weights, for recordings."""
        model, engine = self._model, self.engine
        return {
            "model": model.name, "type": model.type, "fingerprint": self.policy.fingerprint(),
            "weights": engine.stats.weights, "execution_mode": engine.stats.mode,
        }  # fmt: skip

    @override
    def start(self) -> None:
        model, session = self._model, self._session
        policy = session.make("policy", model, model.name)
        units = check_model(session.config, model, policy.spec, session.log)
        topics = {part.topic for key in policy.spec.observations for part in self.contract.parts(key)}
        session.refuse_absent(f"model {model.name!r}", topics.__contains__)
        if units is not None:
            policy = PolicyInItsUnits(policy, units)
        self._policy = policy
        self._engine = self._made_engine(policy)
        self._engine.start()

    def _made_engine(self, policy: Policy) -> Engine:
        session, inference = self._session, self._inference
        match inference.execution_mode:
            case "process":
                return ProcessEngine(
                    session.config, inference.model, policy.fingerprint(), session.request.seed, session.finished,
                    inference.hang_timeout, accept_new_weights=inference.accept_new_weights,
                )  # fmt: skip
            case "distributed":
                assert self._link is not None, "the YAML's checks require a transport"
                return RemoteEngine(
                    policy, self._link.transport, inference.server_model or inference.model, session.config.robot.name,
                    start_timeout_s=inference.request_timeout, codec=self._codec(policy),
                    accept_new_weights=inference.accept_new_weights,
                )  # fmt: skip
            case _:
                return LocalEngine(policy)

    def _codec(self, policy: Policy) -> PictureCodec | None:
        quality = self._inference.jpeg_quality
        if quality is None:
            return None
        codec = policy.picture_codec(quality)
        if codec is None:
            raise PolicyError(
                f"model {self._model.name!r}: jpeg_quality cannot be used, the policy sends no pictures as they are"
            )
        self._session.log.info(
            "model %s: pictures are sent as JPEG of quality %d, with a loss", self._model.name, quality
        )
        return codec

    @override
    def stop(self) -> None:
        if self._engine is not None:
            self._engine.close()
            self._engine = None
        if self._policy is not None:
            self._policy.close()
            self._policy = None


class PolicySource(SourceWorker):
    """The dispatcher on the contract's ticks, fed by a model."""

    autonomous = True

    def __init__(
        self,
        session: Session,
        mode: ControlMode,
        inference: InferenceConfig,
        model: LoadedModel,
        needs: tuple[str, ...],
    ) -> None:
        summary = f"{inference.model} through the dispatcher at {session.config.contract.rate_hz:g} Hz"
        super().__init__(session, mode, summary, (*needs, model.name))
        self._inference = inference
        self._model = model
        self._client: InferenceClient | None = None
        self._dispatcher: Dispatcher | None = None

    @property
    def dispatcher(self) -> Dispatcher:
        """The dispatcher, once set up."""
        assert self._dispatcher is not None
        return self._dispatcher

    @override
    def setup(self) -> None:
        policy, engine, contract = self._model.policy, self._model.engine, self._model.contract
        timeout_s = self._inference.request_timeout
        lockstep = self.session.request.lockstep
        self._client = LockstepClient(policy, engine) if lockstep else EngineClient(policy, engine, timeout_s)
        self._dispatcher = Dispatcher(
            contract, policy.spec, self.mode.dispatch, self.session.config.robot, self.session.bus, self._client,
            self._send, timeout_s, self._inference.prompt,
        )  # fmt: skip
        self._step_ns = contract.step_ns

    def toggle_smoothing(self, enabled: bool) -> None:
        """Service: switch the blending of chunks on or off, from the next chunk on."""
        with self.lock:
            self.dispatcher.toggle_smoothing(enabled)

    @override
    def begin_mode(self, seed: int) -> None:
        model = self._model
        self.session.acting = ActingPolicy(self.dispatcher.stats, model.engine.stats, model.described)
        self._next_ns = self.session.bus.snapshot_ns() + self._step_ns
        self.dispatcher.begin(seed)
        self.session.bus.serve(TOGGLE_SMOOTHING, self.toggle_smoothing)

    @override
    def end_mode(self) -> None:
        self.session.bus.unserve(TOGGLE_SMOOTHING)
        self.dispatcher.end()
        self.session.acting = None

    @override
    def work(self, timeout_s: float) -> None:
        assert self._client is not None
        clock = self.session.clock
        wait_s = min(timeout_s, max(0.0, (self._next_ns - clock.now_ns()) / NS_PER_S)) if self.active else timeout_s
        chunk = self._client.poll(wait_s)
        with self.lock:
            now_ns = self.session.bus.snapshot_ns()
            if chunk is not None:
                self.dispatcher.accept(chunk, now_ns)
            if self.active and now_ns >= self._next_ns:
                behind = (now_ns - self._next_ns) // self._step_ns
                self.dispatcher.tick(self._next_ns + behind * self._step_ns)
                self._next_ns += (behind + 1) * self._step_ns
                # In lockstep the answer is there already.
                if self.session.request.lockstep and (chunk := self._client.poll()) is not None:
                    self.dispatcher.accept(chunk, now_ns)

    @override
    def teardown(self) -> None:
        if self._client is not None:
            self._client.close()

    def _send(self, start_ns: int, step_ns: int, positions: Vector) -> None:
        self.session.send_plan(start_ns, step_ns, self._model.contract.action_joints, positions)
