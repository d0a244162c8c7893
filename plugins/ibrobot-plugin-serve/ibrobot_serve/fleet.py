"""Choice among the servers of a model.

Each robot decides by itself, from the offers of all servers. Servers are equal and do not know one another.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from hashlib import blake2b
from typing import Any

import attrs
from attrs.validators import instance_of

from ibrobot_core.api import Payload, PolicyError

LARGEST_CANARY = 0.5
"""Largest share of the robots that a canary may ask for."""
SETTLED_S = 5.0
"""A robot leaves a working server only for one with at least this uptime [s]."""
_AVOIDED_S = 5.0
"""Time for which a robot prefers all other servers to one that failed [s]."""
_OFFER_SIZE, _TEXT_SIZE, _IDENTITY_SIZE = 1 << 20, 128, 1100


def _text(instance: object, attribute: attrs.Attribute[str], value: object) -> None:
    most = _IDENTITY_SIZE if attribute.name == "identity" else _TEXT_SIZE
    if not isinstance(value, str) or len(value) > most:
        raise ValueError(f"{attribute.name} is not a text of at most {most} characters")


def _number(instance: object, attribute: attrs.Attribute[Any], value: object) -> None:
    most = LARGEST_CANARY if attribute.name == "canary" else math.inf
    kinds = int if attribute.name == "robots" else int | float
    if isinstance(value, bool) or not isinstance(value, kinds) or not 0 <= value <= most or value == math.inf:
        raise ValueError(f"{attribute.name} is {value!r:.40}")


@attrs.frozen
class Offer:
    """A server's description of itself. It comes from the network, so everything is checked."""

    server: str
    """Id of the server, new after each start."""
    fingerprint: str = attrs.field(validator=_text)
    """Fingerprint of its policy with the weights."""
    weights: str = attrs.field(validator=_text)
    """Hash of the weights; empty if the policy has none."""
    spec: Mapping[str, Any] = attrs.field(validator=instance_of(dict))
    robots: int = attrs.field(validator=_number)
    """Number of robots that it served recently."""
    canary: float = attrs.field(validator=_number)
    """The share of all robots that may use it although its weights differ; 0: it is an ordinary server."""
    uptime_s: float = attrs.field(validator=_number)
    identity: str = attrs.field(default="", validator=_text)
    """Its version, and what computes its answers."""

    @classmethod
    def read(cls, server: str, payload: Payload) -> Offer:
        """Parse a server's answer.

        Raises:
            PolicyError: if it is not an offer.
        """
        try:
            if len(payload) > _OFFER_SIZE:
                raise ValueError(f"{len(payload)} bytes")
            document = json.loads(bytes(payload))
            given = {field.name: document[field.name] for field in attrs.fields(cls)[1:-1]}
            return cls(server, **given, identity=document.get("identity", ""))
        except (ValueError, TypeError, LookupError, RecursionError) as error:
            raise PolicyError(
                f"{server} is not an ibrobot server: {bytes(payload[:40])!r}…: {type(error).__name__}: {error}"
            ) from None


def _draw(*names: str) -> float:
    """A number from 0 to 1, always the same for the same names."""
    return int.from_bytes(blake2b("\0".join(names).encode(), digest_size=8).digest()) / 2**64


def drawn_canary(canaries: Iterable[Offer], robot: str) -> str:
    """The fingerprint of the canary that a robot is to try; empty for none.

    Each fingerprint gets the largest share that a server asks for it.
    """
    shares: dict[str, float] = {}
    for offer in canaries:
        shares[offer.fingerprint] = max(offer.canary, shares.get(offer.fingerprint, 0.0))
    at = _draw(robot)
    for fingerprint, share in sorted(shares.items()):
        if at < share:
            return fingerprint
        at -= share
    return ""


def ranked(offers: Sequence[Offer], robot: str) -> list[Offer]:
    """The servers in the order in which a new robot should try them: its own order, but those without room last.

    Each robot has an order of its own (rendezvous hashing), so that the robots of a dead server spread over the others
    even if all choose at once, before any server has counted them. A server with fewer robots than an equal share has
    room.
    """
    own = sorted(offers, key=lambda offer: _draw(robot, offer.server))
    return sorted(own, key=lambda offer: offer.robots >= _share(offers, 1))


def _share(offers: Sequence[Offer], more: int = 0) -> int:
    """Robots per server, rounded up, if all of them and `more` new ones were spread evenly."""
    return -(-(sum(offer.robots for offer in offers) + more) // max(1, len(offers)))


@attrs.define
class Choice:
    """Remembers which servers failed a robot.

    Attributes:
        robot: the robot's name, unique among all robots.
    """

    robot: str
    _avoided: dict[str, float] = attrs.field(factory=dict, init=False)

    def avoid(self, server: str, now_s: float) -> None:
        """Try other servers first from now on, for a while."""
        self._avoided = {server: until_s for server, until_s in self._avoided.items() if until_s > now_s}
        self._avoided[server] = now_s + _AVOIDED_S

    def order(self, groups: Sequence[Sequence[Offer]], now_s: float) -> list[Offer]:
        """The servers in the order to try.

        Args:
            groups: servers of equal weights, the preferred ones first.
            now_s: the time [s].
        """
        offers = [offer for group in groups for offer in ranked(group, self.robot)]
        return sorted(offers, key=lambda offer: self._avoids(offer, now_s))

    def reconsider(self, current: str, groups: Sequence[Sequence[Offer]], now_s: float) -> str:
        """The server of a robot that begins an episode: its present one, unless another suits it better.

        It leaves if its server has more than an equal share of the robots, or another group is preferred, but only for
        a server that has been up for a while.
        """
        settled = [[each for each in group if current == each.server or each.uptime_s >= SETTLED_S] for group in groups]
        home = next((group for group in settled if group), [])
        mine = [offer for offer in home if offer.server == current]
        if not home or (mine and mine[0].robots <= _share(home)):
            return current
        best = self.order([home], now_s)[0]
        return current if self._avoids(best, now_s) else best.server

    def _avoids(self, offer: Offer, now_s: float) -> bool:
        return self._avoided.get(offer.server, -math.inf) > now_s
