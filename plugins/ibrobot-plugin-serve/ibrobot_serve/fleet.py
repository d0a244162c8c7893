"""Choice among the servers of a model.

Each robot decides by itself, from the offers of all servers. Servers are equal and do not know one another.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from hashlib import blake2b
from statistics import median_low
from typing import Any

import attrs
from attrs.validators import instance_of

from ibrobot_core.api import Payload, PolicyError

LARGEST_CANARY = 0.5
"""Largest share of the robots that a canary may ask for."""
SETTLED_S = 5.0
"""A robot leaves a working server only for one with at least this uptime [s]."""
_AVOIDED_S, _LONGEST_AVOIDED_S = 5.0, 60.0
"""Time for which a robot prefers all other servers to one that failed [s]; it doubles with each further failure."""
_SLOW_FACTOR, _SLOW_MS = 3.0, 50.0
"""A server is slow if its answers take this many times as long as those of the others, and this much longer."""
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
    failing: bool = attrs.field(default=False, validator=instance_of(bool))
    """Whether its model fails all requests."""
    latency_ms: float = attrs.field(default=0.0, validator=_number)
    """Median time from a request to its answer, as the server measures it; 0: unknown."""

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
            fields = [field for field in attrs.fields(cls) if field.name != "server"]
            needed = [field for field in fields if field.default is attrs.NOTHING or field.name in document]
            return cls(server, **{field.name: document[field.name] for field in needed})
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


def good(offers: Sequence[Offer]) -> list[Offer]:
    """The servers whose models work, and that are not much slower than the others; all of them if none is."""
    working = [offer for offer in offers if not offer.failing] or list(offers)
    return [offer for offer in working if not is_slow(offer, working)] or working


def is_slow(offer: Offer, offers: Iterable[Offer]) -> bool:
    """Whether a server's answers take much longer than those of the others.

    It is compared with the median of the others, the lower one of two.
    """
    others = [each.latency_ms for each in offers if each.server != offer.server and each.latency_ms > 0]
    if not others:
        return False
    usual_ms = median_low(others)
    return offer.latency_ms > max(_SLOW_FACTOR * usual_ms, usual_ms + _SLOW_MS)


def ranked(offers: Sequence[Offer], robot: str) -> list[Offer]:
    """The servers in the order in which a new robot should try them.

    Each robot has an order of its own (rendezvous hashing), so that the robots of a dead server spread over the others
    even if all choose at once, before any server has counted them. Servers without room come later, and those that
    fail or are slow last. A server with fewer robots than an equal share has room.
    """
    own = sorted(offers, key=lambda offer: _draw(robot, offer.server))
    best = good(offers)
    return sorted(own, key=lambda offer: (offer not in best, offer.robots >= _share(best, 1)))


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
    _avoided: dict[str, tuple[float, float]] = attrs.field(factory=dict, init=False)
    """End of the time in which a server is avoided [s], and its length [s]."""

    def avoid(self, server: str, now_s: float) -> None:
        """Try other servers first from now on, for a while."""
        kept = {name: each for name, each in self._avoided.items() if each[0] + _LONGEST_AVOIDED_S > now_s}
        pause_s = min(_LONGEST_AVOIDED_S, 2 * kept[server][1]) if server in kept else _AVOIDED_S
        self._avoided = {**kept, server: (now_s + pause_s, pause_s)}

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

        It leaves if its server fails, is slow, or has more than an equal share of the robots, or if another group is
        preferred, but only for a server that has been up for a while.
        """
        settled = [[each for each in group if current == each.server or each.uptime_s >= SETTLED_S] for group in groups]
        home = next((group for group in settled if group), [])
        best = good(home)
        if not home or any(offer.server == current and offer.robots <= _share(best) for offer in best):
            return current
        first = self.order([home], now_s)[0]
        return current if self._avoids(first, now_s) else first.server

    def _avoids(self, offer: Offer, now_s: float) -> bool:
        return offer.server in self._avoided and self._avoided[offer.server][0] > now_s
