"""Execution mode `distributed`: `infer` on a server, over a transport."""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Mapping
from typing import Any, Self, override

import attrs

from ibrobot_core.api import (
    NS_PER_S,
    Context,
    ContractError,
    Engine,
    PictureCodec,
    Policy,
    PolicyError,
    Tensors,
    Transport,
    TransportError,
)
from ibrobot_core.app import WireError
from ibrobot_serve.options import DistributedOptions
from ibrobot_serve.weights import check_weights
from ibrobot_serve.wire import (
    WIRE_LIMITS,
    Buffer,
    WireDecoder,
    WireEncoder,
    WireKind,
    WireLimits,
    WireMessage,
    health_name,
    service_name,
    whole_fingerprint,
)

_HEALTH_TIMEOUT_S = 2.0
_HEALTH_SIZE = 1 << 20
_RETRY_S = 0.2
_PARALLEL = 8
"""Concurrent requests to a server whose model does not remember them."""


class RemoteEngine(Engine):
    """The model on a server; the robot's side has no weights.

    While the server is unreachable, requests fail and the arm holds. Once it is back it answers again, because each
    request contains everything that a server needs. The transport reconnects by itself.

    Args:
        policy: the robot's side; its fingerprint must equal that of the server's.
        transport: the connection to the server; its owner closes it.
        model: name of the model on the server.
        robot: this robot's name; a suffix makes it unique among the server's robots.
        start_timeout_s: how long `start` waits for a server [s].
        codec: encodes camera images as JPEG, for slow links.
        limits: the server's.
        accept_new_weights: continue, with a warning, if the server restarts with other weights.
    """

    def __init__(
        self, policy: Policy, transport: Transport, model: str, robot: str, start_timeout_s: float = 5.0,
        codec: PictureCodec | None = None, limits: WireLimits = WIRE_LIMITS, *, accept_new_weights: bool = False,
    ) -> None:  # fmt: skip
        super().__init__("distributed")
        self._policy = policy
        self._fingerprint = policy.fingerprint()
        """Includes the server's weights, once they are known."""
        self._accept_new_weights = accept_new_weights
        self._changed = threading.Event()
        """Set when an answer came from another policy."""
        self._looking = threading.Lock()
        self._transport = transport
        self._model = model
        self._robot = f"{robot}-{uuid.uuid4().hex[:8]}"
        self._start_timeout_s = start_timeout_s
        self.parallel = 1 if policy.spec.stateful else _PARALLEL
        self._encoder, self._decoder = WireEncoder(limits, codec), WireDecoder(limits)
        self._buffers = [Buffer() for _ in range(self.parallel)]
        """Free buffers."""
        self._episode = time.time_ns()
        """Starts at the time, so that a restart with the same certificate does not repeat an episode's number."""
        self._end_watch: Callable[[], None] | None = None

    @classmethod
    def from_context(cls, options: DistributedOptions, ctx: Context) -> Self:
        """The engine that a robot YAML describes.

        Raises:
            PolicyError: for `jpeg_quality`, if the policy sends no raw images.
        """
        model = ctx.model
        assert model is not None
        assert model.transport is not None, "the YAML's checks require a transport"
        codec = None
        if options.jpeg_quality is not None:
            codec = model.policy.picture_codec(options.jpeg_quality)
            if codec is None:
                raise PolicyError(f"model {ctx.name!r}: jpeg_quality cannot be used: the policy sends no raw images")
            message = "model %s: images are sent as JPEG of quality %d, which is lossy"
            logging.getLogger("ibrobot.inference").info(message, ctx.name, options.jpeg_quality)
        return cls(
            model.policy, model.transport, options.server_model or ctx.name, ctx.robot.name,
            start_timeout_s=model.timeout_s, codec=codec, accept_new_weights=options.accept_new_weights,
        )  # fmt: skip

    @override
    def start(self) -> None:
        deadline_s = time.monotonic() + self._start_timeout_s
        while True:
            try:
                health = self._health()
                break
            except TransportError as error:
                if time.monotonic() >= deadline_s:
                    raise PolicyError(f"no server for model {self._model!r}: {error}") from None
                time.sleep(_RETRY_S)
        self._adopt(health)
        self._end_watch = self._transport.watch(service_name(self._model), self._served)

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        if self._changed.is_set():
            self._look_again()
        fingerprint = self._fingerprint
        left_ns = deadline_ns - time.monotonic_ns()
        if left_ns <= 0:
            raise PolicyError(f"request {request_id} expired before it was sent")
        message = WireMessage(
            WireKind.REQUEST, request_id, tensors, self._robot, fingerprint, stamp_ns=time.time_ns(),
            deadline_ns=left_ns, episode=self._episode, seed=self._seed,
        )  # fmt: skip
        buffer = self._buffers.pop()
        try:
            frame = self._encoder.encode(message, buffer.allocate)
            reply = self._transport.request(service_name(self._model), frame, left_ns / NS_PER_S)
            answer = self._decoder.decode(reply)
        except (TransportError, WireError) as error:
            raise PolicyError(str(error)) from None
        finally:
            self._buffers.append(buffer)
        self.stats.pace_ms = answer.pace_ns / 1e6
        if answer.fingerprint not in ("", fingerprint):
            self._changed.set()
        if answer.kind is WireKind.FAILURE:
            raise PolicyError(f"the server of {self._model}: {answer.text}")
        if answer.id != request_id or answer.fingerprint != fingerprint:
            raise PolicyError(
                f"the server of {self._model} answered request {answer.id} with policy {answer.fingerprint!r}; "
                f"expected request {request_id} with policy {fingerprint!r}"
            )
        self.stats.queue_ms = min(answer.queued_ns / 1e6, answer.latency_ms)
        self.stats.model_ms = answer.latency_ms - self.stats.queue_ms
        return answer.tensors

    @override
    def close(self) -> None:
        end, self._end_watch = self._end_watch, None
        if end is not None:
            end()

    def _look_again(self) -> None:
        """Check which policy the server has now.

        Raises:
            PolicyError: when the policy differs, or its weights differ and are not accepted.
        """
        with self._looking:
            if not self._changed.is_set():
                return
            try:
                self._adopt(self._health())
            except (TransportError, ContractError) as error:
                raise PolicyError(str(error)) from None
            self._changed.clear()

    def _adopt(self, health: Mapping[str, Any]) -> None:
        """Use the server's weights, if its policy is the robot's."""
        weights = str(health.get("weights", ""))[:128]
        fingerprint = whole_fingerprint(self._policy.fingerprint(), weights)
        if health.get("fingerprint") != fingerprint:
            raise ContractError(self._differences(health, fingerprint))
        check_weights(self.stats.weights, weights, f"the server of {self._model}", accept=self._accept_new_weights)
        self._fingerprint, self.stats.weights = fingerprint, weights

    def _served(self, alive: bool) -> None:
        self.stats.restarts += alive and self.stats.requests > 0
        self.stats.alive = alive

    def _health(self) -> Mapping[str, Any]:
        reply = self._transport.request(health_name(self._model), b"", _HEALTH_TIMEOUT_S)
        try:
            health = json.loads(bytes(reply)) if len(reply) <= _HEALTH_SIZE else None
        except ValueError:
            health = None
        if not isinstance(health, dict):
            raise PolicyError(
                f"the server of {health_name(self._model)} is not an ibrobot server: {bytes(reply)[:40]!r}…"
            )
        return health

    def _differences(self, health: Mapping[str, Any], fingerprint: str) -> str:
        """The differences of both policies."""
        known = health["spec"] if isinstance(health.get("spec"), dict) else {}
        ours = json.loads(json.dumps(attrs.asdict(self._policy.spec)))
        lines = [f"the policy on the server is not the robot's model {self._model!r}:"]
        for field in known:
            if known[field] != ours.get(field):
                lines.append(f"  {field}\n      robot: {ours.get(field)}\n     server: {known[field]}")
        lines.append(f"  fingerprint\n      robot: {fingerprint}\n     server: {health.get('fingerprint')}")
        if len(lines) == 2:  # the fingerprint alone
            lines.append(
                "  equal specs, but files or options differ, e.g. statistics: copy the server's files, without weights"
            )
        return "\n".join(lines)
