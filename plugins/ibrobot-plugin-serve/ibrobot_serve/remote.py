"""Execution mode `distributed`: `infer` on a server, over a transport."""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections.abc import Callable, Sequence, Set
from typing import Self, override

import attrs
import numpy as np

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
from ibrobot_serve.fleet import Choice, Offer, drawn_canary, good, ranked
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
    offer_name,
    server_name,
    service_name,
    whole_fingerprint,
)

_OFFER_TIMEOUT_S = 0.3
"""Maximum time that a robot waits for the offers of servers [s]."""
_REASON_TIMEOUT_S = 2.0
_RETRY_S = 0.2
_REVIEW_S = 5.0
"""How often a robot compares its server with the others within an episode [s]."""
_PARALLEL = 8
"""Maximum number of concurrent requests to a server with a stateless model."""


class _OtherServerError(PolicyError):
    """This server did not answer, but another may."""


class _UnavailableError(_OtherServerError):
    """It cannot be reached, or takes no robots."""


class _ModelError(PolicyError):
    """The model failed on this request: a fault of the request, or of this server."""


class RemoteEngine(Engine):
    """The model on a server; the robot's side has no weights.

    A robot keeps its server until it dies, fails, is much slower than others, or stops accepting robots; it may also
    change at the start of an episode, if another server has more room. A request on which the model fails is sent to
    the other servers: if one answers, the fault was the server's, and the robot leaves it. While no server is
    reachable, requests fail and the arm holds. Each request contains everything that a server needs. The transport
    reconnects by itself.

    Args:
        policy: the robot's side; must have the fingerprint of the server's policy.
        transport: the connection to the servers; its owner closes it.
        model: name of the model on the servers.
        robot: this robot's name; a suffix makes it unique among all robots.
        start_timeout_s: how long `start` waits for a server [s].
        codec: encodes camera images as JPEG, for slow links.
        limits: limits of the server.
        accept_new_weights: continue, with a warning, if only servers with other weights are left.
        canary: take part if a server offers other weights to a share of the robots.
    """

    def __init__(
        self, policy: Policy, transport: Transport, model: str, robot: str, start_timeout_s: float = 5.0,
        codec: PictureCodec | None = None, limits: WireLimits = WIRE_LIMITS, *, accept_new_weights: bool = False,
        canary: bool = True,
    ) -> None:  # fmt: skip
        super().__init__("distributed")
        self._policy = policy
        self._accept_new_weights = accept_new_weights
        self._takes_canaries = canary
        self._transport = transport
        self._model = model
        self._robot = f"{robot}-{uuid.uuid4().hex[:8]}"
        self._choice = Choice(self._robot)
        self._start_timeout_s = start_timeout_s
        self.parallel = 1 if policy.spec.stateful else _PARALLEL
        self._encoder, self._decoder = WireEncoder(limits, codec), WireDecoder(limits)
        self._buffers = [Buffer() for _ in range(self.parallel)]
        """Free buffers."""
        self._episode = time.time_ns()
        """Begins at the present time, so that a restarted robot with the same name does not repeat a number."""
        self._choosing = threading.Lock()
        self._session: Offer | None = None
        """The server in use, as it described itself when it was chosen."""
        self._last_server = ""
        self._weights: str | None = None
        """Hash of the weights of the servers, except canaries; None before the first was chosen."""
        self._reconsider = False
        """Whether an episode has begun since the server was chosen."""
        self._review_s = 0.0
        """When to compare the server with the others [s]."""
        self._left: set[str] = set()
        """Fingerprints of the canaries that this robot has left."""
        self._sent = 0
        self._failed = False
        """Whether the last request failed because of the model."""
        self._log = logging.getLogger("ibrobot.inference")
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
            canary=options.canary,
        )  # fmt: skip

    @override
    def start(self) -> None:
        deadline_s = time.monotonic() + self._start_timeout_s
        while True:
            try:
                self._session_for(frozenset())
                break
            except TransportError as error:
                if time.monotonic() >= deadline_s:
                    raise PolicyError(f"no server for model {self._model!r}: {error}") from None
                time.sleep(_RETRY_S)
        self._end_watch = self._transport.watch(service_name(self._model), self._served)

    @override
    def reset(self, seed: int) -> None:
        super().reset(seed)
        self._reconsider = True

    @override
    def run(self, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        with self._choosing:
            self._sent += 1
            number = self._sent
        tried: set[str] = set()
        failed: dict[str, Offer] = {}
        """Servers whose model failed on this request -> their offers."""
        failure: PolicyError | None = None
        while True:
            try:
                session = self._session_for(tried)
            except (TransportError, ContractError, PolicyError) as error:
                if failed:
                    self._stay(*failed.values())
                if failure is None and not isinstance(error, PolicyError):
                    raise PolicyError(str(error)) from None
                raise failure or error from None
            try:
                outputs = self._ask(session, tensors, request_id, deadline_ns)
            except _ModelError as error:
                failure = failure if failed else error
                # A newer request means that nobody needs this one. A policy with a history loses it when it moves.
                if number != self._sent or (self._policy.spec.stateful and not self._failed):
                    self._failed = True
                    raise
                failed[session.server] = session
                self._set_aside(session)
            except _OtherServerError as error:
                late = time.monotonic_ns() >= deadline_ns
                failure = failure if failed else error
                if not failed or not late:
                    self._leave(session, str(error), forever=late or not isinstance(error, _UnavailableError))
            else:
                self._failed = False
                for offer in failed.values():
                    self._leave(offer, f"{failure}; server {session.server} answered the same request")
                return outputs
            tried.add(session.server)
            if failure is not None and time.monotonic_ns() >= deadline_ns:
                for offer in failed.values():  # there was no time to try others: they come first next time
                    self._leave(offer, str(failure))
                raise failure

    @override
    def close(self) -> None:
        end, self._end_watch = self._end_watch, None
        if end is not None:
            end()

    def _ask(self, session: Offer, tensors: Tensors, request_id: int, deadline_ns: int) -> Tensors:
        """The answer of one server.

        Raises:
            PolicyError: for a fault of this request.
            _ModelError: if the model failed.
            _OtherServerError: for a fault of this server.
        """
        left_ns = deadline_ns - time.monotonic_ns()
        if left_ns <= 0:
            raise PolicyError(f"request {request_id} expired before it was sent")
        message = WireMessage(
            WireKind.REQUEST, request_id, tensors, self._robot, session.fingerprint, stamp_ns=time.time_ns(),
            deadline_ns=left_ns, episode=self._episode, seed=self._seed,
        )  # fmt: skip
        buffer = self._buffers.pop()
        try:
            frame = self._encoder.encode(message, buffer.allocate)
        except WireError as error:
            self._buffers.append(buffer)
            raise PolicyError(str(error)) from None
        try:
            name = server_name(self._model, session.server)
            answer = self._decoder.decode(self._transport.request(name, frame, left_ns / NS_PER_S))
        except TransportError as error:
            raise _UnavailableError(str(error)) from None
        except WireError as error:
            raise _OtherServerError(str(error)) from None
        finally:
            self._buffers.append(buffer)
        self.stats.pace_ms = answer.pace_ns / 1e6
        if answer.kind is WireKind.REFUSAL:
            raise _UnavailableError(f"the server of {self._model}: {answer.text}")
        if answer.kind is WireKind.FAILURE:
            raise _ModelError(f"the server of {self._model}: {answer.text}")
        if answer.id != request_id or answer.fingerprint != session.fingerprint:
            raise _OtherServerError(
                f"the server of {self._model} answered request {answer.id} with policy {answer.fingerprint!r}; "
                f"expected request {request_id} with policy {session.fingerprint!r}"
            )
        for tensor, array in answer.tensors.items():
            if not np.isfinite(array).all():
                value = "NaN" if np.isnan(array).any() else "infinity"
                raise _OtherServerError(f"the server of {self._model} answered with {value} in {tensor!r}")
        self.stats.queue_ms = min(answer.queued_ns / 1e6, answer.latency_ms)
        self.stats.model_ms = answer.latency_ms - self.stats.queue_ms
        return answer.tensors

    def _leave(self, session: Offer, why: str, *, forever: bool = True) -> None:
        """Choose another server for the next request, if there is one; leave a canary `forever`, or for a while."""
        with self._choosing:
            self._choice.avoid(session.server, time.monotonic())
            if session.canary and forever:
                self._left.add(session.fingerprint)
            if self._session is session:
                self._session = None
            self._log.warning("model %s: server %s failed: %s", self._model, session.server, why)

    def _set_aside(self, session: Offer) -> None:
        """Try the present request at another server, before a verdict on this one."""
        with self._choosing:
            if self._session is session:
                self._session = None

    def _stay(self, first: Offer, *others: Offer) -> None:
        """Keep the server that was asked first: a request that fails at all servers is wrong itself."""
        self._failed = True
        with self._choosing:
            if self._session is None:
                self._begin(first)

    def _session_for(self, tried: Set[str]) -> Offer:
        """The present session, or a new one with a server that was not tried.

        Raises:
            TransportError: if no server can be reached.
            ContractError: if they have another policy.
            PolicyError: if they have other weights.
        """
        with self._choosing:
            offered = self._transport.served(offer_name(self._model))
            session = self._session
            if session is not None and offer_name(self._model, session.server) not in offered:
                session = None
            if session is not None and session.server not in tried:
                return self._reconsidered(session, offered)
            groups = self._groups([offer for offer in self._offers(offered) if offer.server not in tried])
            return self._begin(self._choice.order(groups, time.monotonic())[0])

    def _reconsidered(self, session: Offer, offered: frozenset[str]) -> Offer:
        """The session of a new episode, or of one in which another server has become better.

        Within an episode, a robot leaves a server only because the server fails or is slow, and not if the policy has a
        history.
        """
        now_s = time.monotonic()
        if not self._reconsider and (self._policy.spec.stateful or now_s < self._review_s):
            return session
        self._review_s = now_s + _REVIEW_S
        try:
            offers = self._offers(offered)
            groups = self._groups(offers)
            mine = next((offer for offer in offers if offer.server == session.server), None)
            if not self._reconsider:  # robots begin to try a canary with an episode
                groups = [[offer for offer in group if not offer.canary or session.canary] for group in groups]
            poor = mine is not None and mine not in good([mine, *(each for group in groups for each in group)])
            server = session.server
            if self._reconsider or poor:
                server = self._choice.reconsider(session.server, groups, now_s)
        except (TransportError, PolicyError, ContractError) as error:
            self._log.info("model %s: stays at server %s: %s", self._model, session.server, error)
            return session
        self._reconsider = False
        if server == session.server:
            return session
        if poor and mine is not None:
            self._choice.avoid(mine.server, now_s)
            if mine.canary:
                self._left.add(mine.fingerprint)
            state = "its model fails" if mine.failing else f"its answers take {mine.latency_ms:.0f} ms"
            self._log.warning("model %s: leaves server %s: %s", self._model, mine.server, state)
        return self._begin(next(offer for offer in offers if offer.server == server))

    def _begin(self, offer: Offer) -> Offer:
        """Begin a session with a server. If its model is stateful, it must forget this robot's earlier episodes."""
        if self._last_server not in ("", offer.server):
            self._episode += 1
            move = (self._model, self._last_server, offer.server, offer.weights)
            self._log.info("model %s: moves from server %s to %s, weights %s", *move)
        if offer.canary:
            self._log.warning("model %s: this robot tries the canary with weights %s", self._model, offer.weights)
        self._last_server, self.stats.weights = offer.server, offer.weights
        self.stats.server = f"{offer.server}: {offer.identity}"
        self._session = offer
        self._review_s = time.monotonic() + _REVIEW_S
        return offer

    def _offers(self, names: frozenset[str]) -> list[Offer]:
        """Ask the servers of these names for their offers.

        Raises:
            TransportError: if there are none, or none answers.
            PolicyError: if none is an ibrobot server.
        """
        offers: list[Offer] = []
        failure: TransportError | PolicyError | None = None
        for name in sorted(names):
            try:
                payload = self._transport.request(name, b"", _OFFER_TIMEOUT_S)
                offers.append(Offer.read(name.rpartition("/")[2], payload))
            except (TransportError, PolicyError) as error:
                failure = error
        if not offers:
            if failure is None:  # the transport states the reason, e.g. a missing connection
                self._transport.request(health_name(self._model), b"", _REASON_TIMEOUT_S)
                failure = TransportError(f"no server of {self._model} accepts robots at present")
            raise failure
        return offers

    def _groups(self, offers: Sequence[Offer]) -> list[list[Offer]]:
        """The servers that this robot may use, by weights: those of a canary that it is to try, and the others."""
        if not offers:
            raise TransportError(f"no other server of {self._model} accepts robots")
        ours = self._policy.fingerprint()
        same = [offer for offer in offers if offer.fingerprint == whole_fingerprint(ours, offer.weights)]
        if not same:
            raise ContractError(self._differences(offers[0], whole_fingerprint(ours, offers[0].weights)))
        canaries = [offer for offer in same if offer.canary] if self._takes_canaries else []
        drawn = drawn_canary(canaries, self._robot)
        tried = [offer for offer in canaries if offer.fingerprint == drawn]
        others = [offer for offer in same if not offer.canary]
        best = good([*tried, *others])
        trying = [offer for offer in tried if offer in best and drawn not in self._left]
        try:
            groups = [trying, self._of_one_weights(others)]
        except PolicyError:
            if not trying:
                raise
            groups = [trying]
        if not any(groups):  # a canary that this robot has left is better than no server
            groups = [tried]
        if not any(groups):
            raise PolicyError(f"the only servers of {self._model} are canaries, which this robot does not try")
        return groups

    def _of_one_weights(self, offers: list[Offer]) -> list[Offer]:
        """The servers with the weights that this robot uses.

        Raises:
            PolicyError: if none has them, or the robot has none yet and the servers disagree.
        """
        known = {offer.weights for offer in offers}
        if self._weights in known or not known:
            return [offer for offer in offers if offer.weights == self._weights]
        chosen = ranked(offers, self._robot)[0].weights
        if self._weights is not None:
            check_weights(self._weights, chosen, f"the server of {self._model}", accept=self._accept_new_weights)
        elif len(known) > 1 and not self._accept_new_weights:
            raise PolicyError(
                f"the servers of {self._model} have different weights: {', '.join(sorted(known))}; stop those that are "
                "not wanted, start them with --canary SHARE, or set inference.accept_new_weights: true"
            )
        self._weights = chosen
        return [offer for offer in offers if offer.weights == chosen]

    def _served(self, alive: bool) -> None:
        self.stats.restarts += alive and self.stats.requests > 0
        self.stats.alive = alive

    def _differences(self, offer: Offer, fingerprint: str) -> str:
        """The differences of both policies."""
        ours = json.loads(json.dumps(attrs.asdict(self._policy.spec)))
        lines = [f"the policy on the server is not the robot's model {self._model!r}:"]
        for field, theirs in offer.spec.items():
            if theirs != ours.get(field):
                lines.append(f"  {field}\n      robot: {ours.get(field)}\n     server: {theirs}")
        lines.append(f"  fingerprint\n      robot: {fingerprint}\n     server: {offer.fingerprint}")
        if len(lines) == 2:  # the fingerprint alone
            lines.append(
                "  equal specs, but files or options differ, e.g. statistics: copy the server's files, without weights"
            )
        return "\n".join(lines)
