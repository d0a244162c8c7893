"""Options: where a server is, and how the contract's vectors and images become its request and its actions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import attrs

from ibrobot_core.api import Options, documented, option


def _websocket(instance: Any, attribute: attrs.Attribute[Any], value: str) -> None:
    parts = urlsplit(value)
    if parts.scheme not in ("ws", "wss") or not parts.hostname:
        raise ValueError("must be ws://HOST:PORT or wss://HOST:PORT")


def _not_empty(instance: Any, attribute: attrs.Attribute[Any], value: Sequence[Any]) -> None:
    if not value:
        raise ValueError("must not be empty")


def _host_and_port(instance: Any, attribute: attrs.Attribute[Any], value: str) -> None:
    if not re.fullmatch(r"([^\s/:]+|\[[0-9a-fA-F:]+\]):\d{1,5}", value):
        raise ValueError("must be HOST:PORT")


def _tcp(instance: Any, attribute: attrs.Attribute[Any], value: str) -> None:
    if not re.fullmatch(r"tcp://[^\s/:]+:\d{1,5}|ipc://\S+", value):
        raise ValueError("must be tcp://HOST:PORT, or ipc://PATH")


@documented
@attrs.frozen
class ObservationMap:
    """An observation of the contract in the server's request."""

    observation: str = option(help="key of the contract, or of the model's extra_observations")
    key: tuple[str, ...] = option(
        validator=_not_empty, help="where the server expects it: [observation/state], or [images, cam_high] if nested"
    )
    shape: tuple[int, ...] = option(
        validator=_not_empty, help="its shape in the contract: [N] for a vector, [H, W, 3] for an image"
    )
    layout: str = option("hwc", choices=("hwc", "chw"), help="order of an image's dimensions at the server")
    joints: tuple[str, ...] = option((), help="the joints of a vector, in order; for actions relative to them")
    scale: tuple[float, ...] = option(
        (), help="the server's value is scale * value + offset, one number for each element; by default 1"
    )
    offset: tuple[float, ...] = option((), help="see scale; by default 0")


@documented
@attrs.frozen
class ActionMap:
    """A vector of the server's answer, and the joints that it moves."""

    joints: tuple[str, ...] = option(validator=_not_empty, help="joints of its elements, in the server's order")
    key: tuple[str, ...] = option(("actions",), validator=_not_empty, help="where the answer has it")
    size: int | None = option(None, ge=1, help="number of its elements if larger; those after the joints are ignored")
    relative: tuple[str, ...] = option((), help="joints whose values are added to the position at the observation")
    scale: tuple[float, ...] = option((), help="the joint's value is scale * value + offset; by default 1")
    offset: tuple[float, ...] = option((), help="see scale; by default 0")


@documented
@attrs.frozen
class ServerOptions(Options):
    """The mapping to a server, and how long to wait for it."""

    observations: tuple[ObservationMap, ...] = option(validator=_not_empty, help="what the server gets")
    actions: tuple[ActionMap, ...] = option(validator=_not_empty, help="what it answers")
    horizon: int = option(ge=1, le=10_000, help="number of actions in an answer")
    rate_hz: float = option(unit="Hz", gt=0, help="rate of the actions in an answer")
    prompt: tuple[str, ...] = option(("prompt",), help="where the server expects the prompt; empty: it takes none")
    use_actions: int | None = option(None, ge=1, help="number of actions of an answer to use; by default all")
    timeout: float = option(
        5.0, unit="s", gt=0, help="a request without an answer by then fails, and the next one connects again"
    )
    start_timeout: float = option(
        120.0, unit="s", gt=0, help="the same for the first request, when the server may compile its model"
    )
    expect: tuple[str, ...] = option(
        (), help="metadata that the server must state, as name=value, e.g. config=pi05_droid; others are not compared"
    )
    accept_new_model: bool = option(
        False, help="continue, with a warning, if the server restarts with other metadata; otherwise the arm holds"
    )


@documented
@attrs.frozen
class OpenpiOptions(ServerOptions):
    """Address of an openpi server, and the mapping to its model."""

    url: str = option("ws://127.0.0.1:8000", validator=_websocket, help="the server; wss:// for TLS")
    ca: str = option("", help="file with the certificate authority for wss://, in place of the system's")
    api_key: str | None = option(None, secret=True, help="key that the server asks for, e.g. ${OPENPI_API_KEY}")


@documented
@attrs.frozen
class Gr00tOptions(ServerOptions):
    """Address of a policy server of Isaac GR00T, and the mapping to its model."""

    address: str = option("tcp://127.0.0.1:5555", validator=_tcp, help="the server")
    version: str = option(
        "1.6",
        choices=("1.6", "1.5"),
        help="of GR00T: 1.6 nests keys, e.g. [video, front]; 1.5 does not, e.g. [video.front]",
    )
    api_token: str | None = option(
        None, secret=True, help="token that the server asks for, e.g. ${GR00T_TOKEN}; it is sent without encryption"
    )


@documented
@attrs.frozen
class VlaEvalOptions(ServerOptions):
    """Address of a model server of vla-eval, and the mapping to its model."""

    prompt: tuple[str, ...] = option(
        ("task_description",), help="where the server expects the prompt; empty: it takes none"
    )
    url: str = option("ws://127.0.0.1:8000", validator=_websocket, help="the server; wss:// for TLS")
    ca: str = option("", help="file with the certificate authority for wss://, in place of the system's")


@documented
@attrs.frozen(kw_only=True)
class LerobotServerOptions(ServerOptions):
    """Address of LeRobot's policy server, the checkpoint that it loads, and the mapping to it."""

    policy_type: str = option(validator=_not_empty, help="LeRobot's type of the policy, e.g. act")
    pretrained_name_or_path: str = option(
        validator=_not_empty,
        help="the checkpoint: a folder on the server's machine, or a name on the Hugging Face Hub",
    )
    policy_device: str = option("cpu", validator=_not_empty, help="where the server computes, e.g. cuda")
    prompt: tuple[str, ...] = option(("task",), help="[task], or empty: the model takes no prompt")
    address: str = option("127.0.0.1:8080", validator=_host_and_port, help="the server; not encrypted")
