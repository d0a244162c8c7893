"""The access list of a server: deny by default; robots may ask, receive shared topics, and publish in their own name.

Zenoh enforces it with the name in a peer's certificate, or the user name proved by its password. A peer may only use
keys below its own name, so a server identifies the sender of a request by its key.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import attrs
import zenoh

from ibrobot_core.api import TransportError
from ibrobot_zenoh.identity import Identity, Role, read_identity
from ibrobot_zenoh.options import Tls, ZenohOptions, check_robot_name
from ibrobot_zenoh.ros2 import ADMIN

SERVICES, SERVED, TOPICS = "ibrobot/service", "ibrobot/served", "ibrobot/topic"
"""Keys are SERVICES/WHO/NAME for requests, SERVED/NAME/ID for tokens of servers, TOPICS/NAME for plain payloads."""
ANYBODY = "anybody"
"""Name of a sender whose name is not verified."""

_ALL = [
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
    "liveliness_token", "liveliness_query", "declare_liveliness_subscriber",
]  # fmt: skip


@attrs.frozen
class Peers:
    """The peers that may connect.

    Attributes:
        robots: names of the robots.
        proof: how Zenoh verifies names: `cert_common_names` or `usernames`.
        server: the name in this server's certificate, which has all permissions, e.g. for the command line on the same
            machine; empty for none.
    """

    robots: tuple[str, ...]
    proof: str
    server: str = ""


def restrict(config: zenoh.Config, options: ZenohOptions) -> bool:
    """Add the access list to Zenoh's settings; returns whether the key of a request proves its sender.

    It does not if names are not verified, or if the user's settings have their own access list.

    Raises:
        TransportError: if a file is missing or invalid, or a certificate has the wrong role.
    """
    by_password = None if options.users is None else Peers(_users(options.users), "usernames")
    if json.loads(config.get_json("access_control")).get("enabled"):
        return False
    peers = by_password
    if options.tls is not None and options.listen:
        peers = _by_certificate(options.tls, read_identity(options.tls))
    if peers is not None:
        config.insert_json5("access_control", json.dumps(access_control(peers, options.domain)))
    return peers is not None


def _by_certificate(tls: Tls, own: Identity) -> Peers:
    if own.role is not Role.SERVER:
        raise TransportError(
            f"{tls.certificate}: is the certificate of robot {own.name}, which may only connect; to listen, give the "
            "certificate of a server: `ibrobot certs FOLDER --server HOST`"
        )
    if tls.robots is None:
        raise TransportError(
            f"{tls.certificate.parent}: no robot is admitted: set tls.robots to a file with one robot name per line; "
            "`ibrobot certs` writes it as robots.txt in the folder of a server's certificate"
        )
    lines = enumerate(read_lines(tls.robots), 1)
    listed = [(number, name) for number, line in lines if (name := line.partition("#")[0].strip())]
    return Peers(_names(tls.robots, listed), "cert_common_names", own.name)


def _users(path: Path) -> tuple[str, ...]:
    """The names in a users file. It must not be empty: Zenoh would admit everyone."""
    listed = []
    for number, line in enumerate(read_lines(path), 1):
        name, _, password = line.partition(":")
        if not (name and password):
            raise TransportError(f"{path}:{number}: is not NAME:PASSWORD")
        listed.append((number, name))
    if not listed:
        raise TransportError(f"{path}: is empty, must have a line NAME:PASSWORD for each robot")
    return _names(path, listed)


def _names(path: Path, listed: Iterable[tuple[int, str]]) -> tuple[str, ...]:
    names: list[str] = []
    for number, name in listed:
        try:
            check_robot_name(name)
        except ValueError as error:
            raise TransportError(f"{path}:{number}: {error}") from None
        if name in names:
            raise TransportError(f"{path}:{number}: {name!r} is listed twice")
        names.append(name)
    return tuple(names)


def read_lines(path: Path) -> list[str]:
    """The lines of a text file.

    Raises:
        TransportError: if it cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except OSError as error:
        raise TransportError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise TransportError(f"{path}: cannot be read: it is not UTF-8") from error


def access_control(peers: Peers, domain: int) -> dict[str, Any]:
    """Zenoh's `access_control` for a server of `domain`'s topics."""
    rules = {"hear": _hear(domain), **{f"robot {name}": _own(name, domain) for name in peers.robots}}
    subjects = [{"id": f"robot {name}", peers.proof: [name]} for name in peers.robots]
    policies = [{"rules": ["hear", f"robot {name}"], "subjects": [f"robot {name}"]} for name in peers.robots]
    if peers.server:
        everything = ["**", "**/@adv/**", f"{ADMIN}/**"]
        rules["server"] = [_allow(("ingress", "egress"), _ALL, everything)]
        subjects.append({"id": "server", peers.proof: [peers.server]})
        policies.append({"rules": ["server"], "subjects": ["server"]})
    numbered = {name: [{"id": f"{name} {i}", **rule} for i, rule in enumerate(each)] for name, each in rules.items()}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for each in numbered.values() for rule in each],
        "subjects": subjects,
        "policies": [
            {**policy, "rules": [rule["id"] for name in policy["rules"] for rule in numbered[name]]}
            for policy in policies
        ],
    }


def _allow(flows: Sequence[str], messages: Iterable[str], keys: Sequence[str]) -> dict[str, Any]:
    return {"permission": "allow", "flows": [*flows], "messages": [*messages], "key_exprs": [*keys]}


def _hear(domain: int) -> list[dict[str, Any]]:
    """Rules for receiving: every robot sees the servers and all shared topics."""
    # Wildcards do not match parts that begin with @, such as @adv of latched topics.
    shared = [f"{domain}/**", f"{domain}/**/@adv/**", f"{ADMIN}/{domain}/**"]
    return [
        _allow(
            ("ingress",),
            ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"],
            [*shared, f"{TOPICS}/**"],
        ),
        _allow(("ingress",), ["liveliness_query", "declare_liveliness_subscriber"], [f"{SERVED}/**"]),
        _allow(("egress",), ["put", "delete", "reply", "liveliness_token"], [*shared, f"{TOPICS}/**"]),
        _allow(("egress",), ["liveliness_token"], [f"{SERVED}/**"]),
        _allow(("egress",), ["declare_queryable"], [f"{SERVICES}/**"]),
        _allow(
            ("egress",), ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"], ["**", *shared]
        ),
    ]


def _own(name: str, domain: int) -> list[dict[str, Any]]:
    """Rules for the keys below a robot's own name."""
    topics, latched = f"{domain}/{name}/**", f"{domain}/{name}/**/@adv/**"
    return [
        _allow(("ingress",), ["query"], [f"{SERVICES}/{name}/**"]),
        _allow(("egress",), ["reply"], [f"{SERVICES}/{name}/**"]),
        _allow(("ingress",), ["put", "delete", "reply"], [topics, latched, f"{TOPICS}/{name}/**"]),
        _allow(("ingress",), ["declare_queryable", "liveliness_token"], [latched]),
        _allow(("egress",), ["query"], [topics, latched]),
        _allow(
            ("ingress",),
            ["liveliness_token"],
            [
                f"{ADMIN}/{domain}/*/*/*/NN/**",
                f"{ADMIN}/{domain}/*/*/*/MS/**",
                f"{ADMIN}/{domain}/*/*/*/MP/%/%/*/%{name}%$*/**",
            ],
        ),
    ]
