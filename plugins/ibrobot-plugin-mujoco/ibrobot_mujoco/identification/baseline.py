"""The model to beat: each joint follows its command after a delay, with a first-order lag and a bias."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import attrs
import numpy as np
from scipy.optimize import least_squares
from scipy.signal import lfilter

from ibrobot_core.api import Vector
from ibrobot_mujoco.identification.recordings import Recording

_STEP_S = 0.005
_BEGIN_S = ((0.02, 0.1), (0.08, 0.05), (0.13, 0.02))
"""Delays and lags from which the fit begins [s]."""


@attrs.frozen(eq=False)
class Baseline:
    """Delay [s], time constant of the lag [s] and bias [rad] of each joint, shape (J, 3)."""

    values: Vector

    def errors(self, recordings: Sequence[Recording]) -> Vector:
        """Errors of the joints [rad], shape (M, J)."""
        columns = [_errors(each, recordings, joint) for joint, each in enumerate(self.values)]
        return np.stack(columns, axis=1)


def _errors(values: Vector, recordings: Sequence[Recording], joint: int) -> Vector:
    """Errors of a joint [rad], shape (M,)."""
    delay, lag, bias = values
    keep = float(np.exp(-_STEP_S / lag))
    errors = []
    for each in recordings:
        grid = np.arange(0.0, each.seconds + _STEP_S, _STEP_S)
        newest = np.searchsorted(each.command_times, grid, side="right") - 1
        commands = each.commands[np.maximum(newest, 0), joint]
        smooth, _ = lfilter([1 - keep], [1, -keep], commands, zi=[keep * (each.measured[0, joint] - bias)])
        errors.append(np.interp(each.times - delay, grid, smooth) + bias - each.measured[:, joint])
    return np.concatenate(errors)


def fit_baseline(recordings: Sequence[Recording]) -> Baseline:
    """Fit each joint."""
    return Baseline(np.stack([_fitted(recordings, joint) for joint in range(recordings[0].measured.shape[1])]))


def _fitted(recordings: Sequence[Recording], joint: int) -> Vector:
    errors = partial(_errors, recordings=recordings, joint=joint)
    bounds = (0.0, 1e-3, -1.0), (0.5, 2.0, 1.0)
    results = [least_squares(errors, (*begin, 0.0), diff_step=0.02, max_nfev=15, bounds=bounds) for begin in _BEGIN_S]
    best: Vector = min(results, key=lambda each: float(each.cost)).x
    return best
