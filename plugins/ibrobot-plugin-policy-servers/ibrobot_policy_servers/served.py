"""A policy on a server of another project: the mapping to its requests, and the checks of its answers."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import Context, Frame, Policy, PolicyError, PolicySpec, Tensors, did_you_mean
from ibrobot_policy_servers.connection import Connection
from ibrobot_policy_servers.options import ActionMap, ObservationMap, ServerOptions

ACTION = "action"
REFERENCE = "reference"
"""Positions to which relative actions are added, shape (A,), in the order of the action."""
TASK = "task"
"""The prompt in UTF-8, shape (L,)."""


class ServedPolicy(Policy):
    """A policy on a server. `load` connects, checks the server's metadata, and makes one request.

    A request that fails closes the connection, so that a late answer reaches no later request. The next request
    connects again, and fails if the server's metadata has changed.

    Args:
        options: the mapping.
        ctx: provides the robot's joints and the log.
        connection: the protocol.
        stateful: whether the server remembers the requests of an episode.

    Raises:
        PolicyError: if the mapping does not fit the robot.
    """

    def __init__(self, options: ServerOptions, ctx: Context, connection: Connection, *, stateful: bool = False) -> None:
        self._options, self._log, self._connection = options, ctx.log, connection
        self._joints = _joints(options, ctx.robot.joint_names)
        _check_keys(options)
        self._reference = _reference(options)
        self.spec = PolicySpec(
            observations={each.observation: each.shape for each in options.observations},
            actions=self._joints,
            action_size=len(self._joints),
            chunk_size=min(options.horizon, options.use_actions or options.horizon),
            rate_hz=options.rate_hz,
            prompt=bool(options.prompt),
            stateful=stateful,
        )
        self._expected = {each.observation: _tensor(each) for each in options.observations}
        """Tensors of a request: dtypes and shapes."""
        if self.spec.prompt:
            self._expected[TASK] = (np.dtype(np.uint8), (-1,))
        self._turn = threading.Lock()
        """Held during a request."""
        self._connected = False
        self._metadata: Mapping[str, Any] | None = None
        """What the server stated at first."""
        self._weights = self._identity = ""

    @override
    def load(self) -> None:
        with self._turn:
            self._disconnect()
            self._metadata = None
            self._connect(self._options.start_timeout)
            self._log.info("%s states: %s", self._connection.address, _shown(self._metadata or {}))
            self._request(self.preprocess(self._zeros()), self._options.start_timeout)

    @override
    def reset(self, seed: int) -> None:
        with self._turn:
            if self._connected:
                with self._exchange():
                    self._connection.reset(self._options.timeout)

    @override
    def close(self) -> None:
        self._connection.interrupt()
        with self._turn:
            self._disconnect()

    @override
    def fingerprint(self) -> str:
        mapping = attrs.asdict(self._options, filter=lambda field, _: field.name in _MAPPING)
        return hashlib.sha256(json.dumps([mapping, attrs.asdict(self.spec)], sort_keys=True).encode()).hexdigest()[:16]

    @override
    def weights(self) -> str:
        """Hash of the server's metadata, the only thing known of its model."""
        return self._weights

    @override
    def identity(self) -> str:
        """The server's address and metadata; empty before `load`."""
        return self._identity

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        if self.spec.prompt and not frame.prompt:
            raise PolicyError("the server's model needs a prompt that describes the task")
        tensors: dict[str, NDArray[Any]] = {}
        for each in self._options.observations:
            value = frame.observation(each.observation, each.shape)
            if each is self._reference:
                positions = dict(zip(each.joints, value.astype(np.float64), strict=True))
                tensors[REFERENCE] = np.array([positions.get(joint, 0.0) for joint in self._joints])
            tensors[each.observation] = _converted(value, each)
        if self.spec.prompt:
            tensors[TASK] = np.frombuffer(frame.prompt.encode(), np.uint8)
        return tensors

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        with self._turn:
            if not self._connected:
                if self._metadata is None:
                    raise PolicyError(f"{self._connection.address}: is not loaded: call load() first")
                self._connect(self._options.timeout)
            return self._request(tensors, self._options.timeout)

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        values = np.asarray(tensors[ACTION], np.float64)
        maps = self._options.actions
        joints = [joint for each in maps for joint in each.joints]
        scale = np.concatenate([np.broadcast_to(each.scale or 1.0, len(each.joints)) for each in maps])
        offset = np.concatenate([np.broadcast_to(each.offset or 0.0, len(each.joints)) for each in maps])
        actions: NDArray[np.float64] = (values * scale + offset)[:, [joints.index(joint) for joint in self._joints]]
        if REFERENCE in tensors:
            relative = {joint for each in maps for joint in each.relative}
            moved = np.array([joint in relative for joint in self._joints], np.float64)
            actions = actions + moved * np.asarray(tensors[REFERENCE], np.float64)
        return actions[: self.spec.chunk_size]

    def _request(self, tensors: Tensors, timeout_s: float) -> Tensors:
        """One request; any error closes the connection."""
        self.check_tensors(tensors, self._expected, others=True)
        request: dict[str, Any] = {}
        for each in self._options.observations:
            _put(request, each.key, tensors[each.observation])
        if self._options.prompt:
            _put(request, self._options.prompt, tensors[TASK].tobytes().decode(errors="replace"))
        with self._exchange():
            outputs: dict[str, NDArray[Any]] = {ACTION: self._actions(self._connection.ask(request, timeout_s))}
        if REFERENCE in tensors:
            outputs[REFERENCE] = np.array(tensors[REFERENCE])
        return outputs

    def _actions(self, answer: Mapping[str, Any]) -> NDArray[np.float64]:
        """The actions of an answer, shape (N, joints), in the server's order.

        Raises:
            PolicyError: if they have another shape than the mapping states, or are not finite.
        """
        columns = []
        for each in self._options.actions:
            name, size = "/".join(each.key), each.size or len(each.joints)
            value = _get(answer, each.key)
            expected = (self._options.horizon, size)
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "iuf":
                raise PolicyError(f"the answer has no numbers under {name!r}; it has: {_names(answer)}")
            if value.shape != expected:
                raise PolicyError(
                    f"the server's {name!r} has shape {value.shape}, the robot YAML states {expected}: horizon, and "
                    "the size of the action"
                )
            if not np.isfinite(value).all():
                raise PolicyError(f"the server's {name!r} has values that are not finite")
            columns.append(value[:, : len(each.joints)].astype(np.float64))
        return np.concatenate(columns, axis=1)

    def _connect(self, timeout_s: float) -> None:
        with self._exchange():
            metadata = self._connection.open(timeout_s)
            self._check_metadata(metadata)
        self._metadata, self._connected = metadata, True
        self._weights, self._identity = _hash(metadata), f"{self._connection.address[:500]} {_shown(metadata)}"

    def _check_metadata(self, metadata: Mapping[str, Any]) -> None:
        wrong = []
        for each in self._options.expect:
            name, _, value = each.partition("=")
            if (stated := str(metadata.get(name, "nothing"))) != value:
                wrong.append(f"  {name}\n      server: {stated}\n      robot: {value}")
        if wrong:
            raise PolicyError("\n".join(["is not the server that the robot expects:", *wrong]))
        if self._metadata is not None and _hash(metadata) != self._weights:
            change = (
                f"the server restarted with another model: it states {_shown(metadata)}, previously "
                f"{_shown(self._metadata)}"
            )
            if not self._options.accept_new_model:
                raise PolicyError(f"{change}; start the run again, or set the model's accept_new_model: true")
            self._log.warning("%s: %s", self._connection.address, change)

    @contextmanager
    def _exchange(self) -> Iterator[None]:
        """Any error closes the connection, and names the server."""
        try:
            yield
        except PolicyError as error:
            self._disconnect()
            raise PolicyError(f"{self._connection.address}: {error}") from None

    def _disconnect(self) -> None:
        self._connected = False
        self._connection.close()

    def _zeros(self) -> Frame:
        values: dict[str, NDArray[np.generic]] = {
            each.observation: np.zeros(each.shape, np.uint8 if len(each.shape) == 3 else np.float32)
            for each in self._options.observations
        }
        return Frame(0, values, prompt="hold still" if self.spec.prompt else "")


_MAPPING = frozenset({"observations", "actions", "horizon", "rate_hz", "prompt", "use_actions"})
"""Options on which both sides of `infer` must agree."""


def _joints(options: ServerOptions, robot: Sequence[str]) -> tuple[str, ...]:
    """The joints of the action, in the robot's order.

    Raises:
        PolicyError: for a joint that the robot lacks, that stands twice, or that is relative but not in the action.
    """
    moved = [joint for each in options.actions for joint in each.joints]
    for joint in (*moved, *(joint for each in options.observations for joint in each.joints)):
        if joint not in robot:
            raise PolicyError(f"the robot has no joint {joint!r}{did_you_mean(joint, robot, 'it has')}")
    if twice := sorted({joint for joint in moved if moved.count(joint) > 1}):
        raise PolicyError(f"actions: {', '.join(twice)} stand twice")
    for each in options.actions:
        if others := [joint for joint in each.relative if joint not in each.joints]:
            raise PolicyError(
                f"actions: relative names {', '.join(others)}, not among the joints {', '.join(each.joints)}"
            )
        if each.size is not None and each.size < len(each.joints):
            raise PolicyError(f"actions: size is {each.size}, must be at least that of joints, {len(each.joints)}")
        _check_numbers("actions", each, len(each.joints))
    for seen in options.observations:
        if seen.scale or seen.offset:
            _check_numbers(seen.observation, seen, seen.shape[0] if len(seen.shape) == 1 else 0)
        if seen.joints and seen.shape != (len(seen.joints),):
            raise PolicyError(f"{seen.observation}: has shape {list(seen.shape)}, must be [{len(seen.joints)}]")
    return tuple(joint for joint in robot if joint in moved)


def _check_numbers(where: str, each: ObservationMap | ActionMap, size: int) -> None:
    for name, numbers in (("scale", each.scale), ("offset", each.offset)):
        if numbers and len(numbers) != size:
            raise PolicyError(f"{where}: {name} has {len(numbers)} numbers, must have {size}")


def _check_keys(options: ServerOptions) -> None:
    """Check that no value of a request is written over another, and no vector of an answer is read twice.

    Raises:
        PolicyError: if two keys are equal, or one is inside another, or an observation is sent twice.
    """
    sent = [(each.observation, each.key) for each in options.observations]
    for observation, _ in sent:
        if [name for name, _ in sent].count(observation) > 1:
            raise PolicyError(f"observations: {observation} stands twice")
    sent += [("the prompt", options.prompt)] if options.prompt else []
    answered = [(", ".join(each.joints), each.key) for each in options.actions]
    for where, keys in (("request", sent), ("answer", answered)):
        for i, (name, key) in enumerate(keys):
            for other, longer in keys[i + 1 :]:
                shared = min(len(key), len(longer))
                if key[:shared] == longer[:shared]:
                    relation = "the same key" if key == longer else "keys inside one another"
                    raise PolicyError(
                        f"{name} and {other} have {relation} of the {where}: {list(key)} and {list(longer)}; "
                        "each needs one of its own"
                    )


def _reference(options: ServerOptions) -> ObservationMap | None:
    """The observation with the positions to which actions are relative; None without relative actions.

    Raises:
        PolicyError: if there is none.
    """
    relative = {joint for each in options.actions for joint in each.relative}
    if not relative:
        return None
    for each in options.observations:
        if relative <= set(each.joints):
            return each
    raise PolicyError(
        f"actions: {', '.join(sorted(relative))} are relative, but no observation names these joints: add joints to "
        "the observation with their positions"
    )


def _converted(value: NDArray[Any], each: ObservationMap) -> NDArray[Any]:
    """An observation in the server's layout and units."""
    if value.ndim == 3:
        return np.ascontiguousarray(value.transpose(2, 0, 1)) if each.layout == "chw" else np.array(value)
    scaled: NDArray[Any] = value * np.array(each.scale or 1.0) + np.array(each.offset or 0.0)
    return scaled.astype(np.float32)


def _tensor(each: ObservationMap) -> tuple[np.dtype[Any], tuple[int, ...]]:
    """Dtype and shape of an observation in a request."""
    if len(each.shape) != 3:
        return np.dtype(np.float32), each.shape
    height, width, channels = each.shape
    return np.dtype(np.uint8), (channels, height, width) if each.layout == "chw" else each.shape


def _put(request: dict[str, Any], key: Sequence[str], value: Any) -> None:
    for name in key[:-1]:
        request = request.setdefault(name, {})
    request[key[-1]] = value


def _get(answer: Mapping[str, Any], key: Sequence[str]) -> Any:
    value: Any = answer
    for name in key:
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def _names(answer: Mapping[str, Any]) -> str:
    return ", ".join(str(name)[:40] for name in [*answer][:20]) or "nothing"


def _plain(value: Any) -> Any:
    """A server's value with arrays as lists, for comparison and display."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    return value if isinstance(value, str | bool | int | float | None) else repr(value)


def _hash(metadata: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(_plain(metadata), sort_keys=True).encode()).hexdigest()[:32]


def _shown(metadata: Mapping[str, Any]) -> str:
    text = json.dumps(_plain(metadata))
    return text if len(text) < 300 else f"{text[:300]}…"
