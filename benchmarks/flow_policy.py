"""A flow-matching policy without a network, for `smoothness.py`: its velocity field is known in closed form.

Nothing is trained. Its "demonstrations" are a distribution written down here: the arm follows a slow wave along one
of two ways, equally likely, with smooth noise of about a degree. For that mixture of Gaussians the field that flow
matching learns is exact, so what differs between consecutive chunks (the other way, other noise) is what a perfectly
trained policy of two minds would say, drawn again each time: harder than one that sees where it is going.

The guidance is that of real-time chunking (Black et al. 2025, "Real-Time Execution of Action Chunking Flow Policies"):
at each step of the integration the chunk to be expected is drawn towards the prefix, fully for the actions that will be
executed before it arrives, with a weight that fades over the rest of the prefix.
"""

from __future__ import annotations

from typing import override

import numpy as np
from numpy.typing import NDArray

from ibrobot_core.errors import PolicyError
from ibrobot_core.interfaces import Frame, Policy, PolicySpec, Tensors
from ibrobot_core.robot import Robot, Vector

STATE = "observation.state"
STEPS = 10
"""Of the integration from noise to actions."""
GREATEST_GUIDANCE = 5.0
SCALE = 0.3
"""What a policy's normalisation makes 1 [rad]."""
NOISE, ROUGHNESS, CORRELATION_S = 0.02, 0.0005, 0.3
"""Standard deviation of the smooth and of the white part of the noise [rad], and how long the smooth one lasts [s]."""
WAVE_S, CENTRE, AMPLITUDE = 6.0, np.array([0, -0.8, 0.8, 0.4, 0, 0.5]), np.array([0.5, 0.3, 0.3, 0.3, 0.4, 0.4])
WAYS = np.array([[0.12, 0.08, -0.08, 0, 0, 0], [-0.12, -0.08, 0.08, 0, 0, 0]])
"""How far each way lies beside the wave [rad]."""
APPROACH_S = 0.4
"""Time constant with which a chunk goes from the observed state to its way [s]."""


class FlowPolicy(Policy):
    """Chunks by integrating a flow from noise, continuing the prefix of the frame where there is one."""

    def __init__(self, robot: Robot, rate_hz: float, chunk_size: int, seed: int) -> None:
        names = robot.joint_names
        self.spec = PolicySpec({STATE: (len(names),)}, names, len(names), chunk_size, rate_hz, prefix=True)
        self._times_s = np.arange(chunk_size) / rate_hz
        lags = self._times_s[:, None] - self._times_s
        smooth = NOISE**2 * np.exp(-0.5 * (lags / CORRELATION_S) ** 2)
        values, self._basis = np.linalg.eigh((smooth + ROUGHNESS**2 * np.eye(chunk_size)) / SCALE**2)
        self._variances: Vector = np.maximum(values, 0.0)[:, None]
        self._seed = seed

    @override
    def reset(self, seed: int) -> None:
        self._seed = seed

    @override
    def preprocess(self, frame: Frame) -> Tensors:
        if STATE not in frame.values:
            raise PolicyError(f"the frame lacks {STATE}")
        state = frame.values[STATE].astype(np.float64)
        phase = 2 * np.pi * (frame.stamp_ns / 1e9 + self._times_s)[:, None] / WAVE_S
        ways = CENTRE + AMPLITUDE * np.sin(phase + np.arange(len(state))) + WAYS[:, None]
        # Each chunk begins where the arm is.
        ways += (state - ways[:, :1]) * ((1 + self._times_s / APPROACH_S) * np.exp(-self._times_s / APPROACH_S))[
            :, None
        ]
        noise = np.random.default_rng((self._seed, frame.stamp_ns)).standard_normal(ways.shape[1:])
        prefix = np.empty((0, len(state))) if frame.prefix is None else frame.prefix
        return {"ways": ways, "noise": noise, "prefix": prefix, "delay": np.array(frame.delay_steps)}

    @override
    def infer(self, tensors: Tensors) -> Tensors:
        ways = np.asarray(tensors["ways"], np.float64) / SCALE
        prefix = np.asarray(tensors["prefix"], np.float64) / SCALE
        delay = int(tensors["delay"])
        weights = soft_mask(len(prefix), delay)[:, None]
        x = np.asarray(tensors["noise"], np.float64)
        for step in range(STEPS):
            tau = step / STEPS
            expected, responsibilities, means = self._expected(x, tau, ways)
            velocity = (expected - x) / (1 - tau)
            if len(prefix):
                error = np.zeros_like(x)
                error[: len(prefix)] = weights * (prefix - expected[: len(prefix)])
                spread = (1 - tau) ** 2 / (tau**2 + (1 - tau) ** 2)
                guidance = min(GREATEST_GUIDANCE, (1 - tau) / (tau * spread)) if tau else GREATEST_GUIDANCE
                velocity += guidance * self._pulled_back(error, tau, expected, responsibilities, means)
            x = x + velocity / STEPS
        return {"actions": x * SCALE}

    @override
    def postprocess(self, tensors: Tensors) -> NDArray[np.float64]:
        return np.asarray(tensors["actions"], np.float64)

    def _expected(self, x: Vector, tau: float, ways: Vector) -> tuple[Vector, Vector, Vector]:
        """The mean of the chunks that `x = tau * chunk + (1 - tau) * noise` may have come from; shapes as of x.

        And what it is made of: the probability of each way, shape (2,), and its mean, shape (2, N, A).
        """
        total = tau**2 * self._variances + (1 - tau) ** 2
        aside = self._basis.T @ (x - tau * ways)
        likelihood = -0.5 * (aside**2 / total).sum(axis=(1, 2))
        responsibilities = np.exp(likelihood - likelihood.max())
        responsibilities /= responsibilities.sum()
        means = ways + self._basis @ (tau * self._variances / total * aside)
        return np.tensordot(responsibilities, means, 1), responsibilities, means

    def _pulled_back(
        self, error: Vector, tau: float, expected: Vector, responsibilities: Vector, means: Vector
    ) -> Vector:
        """`error` times the Jacobian of `expected`: tau / (1 - tau)^2 times the covariance of what x may come from."""
        noise = (1 - tau) ** 2
        within = self._basis @ (self._variances * noise / (tau**2 * self._variances + noise) * (self._basis.T @ error))
        apart = means - expected
        between = np.tensordot(responsibilities * (apart * error).sum(axis=(1, 2)), apart, 1)
        result: Vector = tau / noise * (within + between)
        return result


def soft_mask(length: int, delay: int) -> Vector:
    """How much each action of a prefix counts: 1 for the first `delay`, then falling exponentially to 0."""
    places = np.arange(length)
    fade = (length - places) / (length - delay + 1)
    return np.where(places < delay, 1.0, fade * np.expm1(fade) / np.expm1(1.0))
