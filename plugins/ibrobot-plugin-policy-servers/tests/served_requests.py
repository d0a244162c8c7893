"""Requests to servers of other projects, the actions that tests expect, and faults that all protocols have."""

from __future__ import annotations

import threading
from typing import Any, Protocol

import numpy as np

from ibrobot_core.api import Frame, Policy, PolicyError

STATE, CAMERA = "observation.state", "observation.images.top"
IMAGE = (8, 10, 3)
SIZE, HORIZON = 6, 5
POSITIONS = np.linspace(-0.5, 0.5, SIZE, dtype=np.float32)


class Answers(Protocol):
    """A server whose answers a test sets."""

    answer: Any


def frame(level: int = 40, prompt: str = "pick up the cube") -> Frame:
    return Frame(7, {STATE: POSITIONS, CAMERA: np.full(IMAGE, level, np.uint8)}, prompt=prompt)


def chunk(policy: Policy, seen: Frame | None = None) -> np.ndarray[Any, Any]:
    return policy.postprocess(policy.infer(policy.preprocess(seen or frame())))


def in_time(policy: Policy, seen: Frame) -> np.ndarray[Any, Any]:
    """A chunk, whatever the load of the machine: requests without an answer in time are repeated."""
    while True:
        try:
            return chunk(policy, seen)
        except PolicyError as error:
            if "no answer within" not in str(error):
                raise


def expected(level: int) -> np.ndarray[Any, Any]:
    return POSITIONS + np.arange(HORIZON)[:, None] * 0.01 + level * 1e-3


def error_when_closed(policy: Policy, server: Answers) -> str:
    """The error of a request that the server does not answer while the policy is closed."""
    asked, errors = threading.Event(), []

    def never(request: object) -> None:
        asked.set()

    def ask() -> None:
        try:
            chunk(policy)
        except PolicyError as error:
            errors.append(str(error))

    server.answer = never
    thread = threading.Thread(target=ask)
    thread.start()
    asked.wait()
    policy.close()
    thread.join()
    [error] = errors
    return error


class Damage:
    """Flips bytes of answers, and cuts a third of the answers."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)

    def __call__(self, good: bytes) -> bytes:
        random, content = self._random, bytearray(good)
        for place in random.integers(0, len(good), random.integers(1, 6)):
            content[place] = random.integers(256)
        return bytes(content[: random.integers(0, len(good) + 1) if random.random() < 0.3 else len(good)])


def refused(policy: Policy, times: int, horizon: int = HORIZON) -> int:
    """Ask; return how many answers were refused. The others have the shape of an answer, and are finite."""
    count = 0
    for _ in range(times):
        try:
            actions = chunk(policy, frame(1))
            assert actions.shape == (horizon, SIZE)
            assert np.isfinite(actions).all()
        except PolicyError:
            count += 1
    return count
