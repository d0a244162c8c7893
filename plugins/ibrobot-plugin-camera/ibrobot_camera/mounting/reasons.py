"""Why pictures and readings cannot tell where a camera is, or contradict each other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations

import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_camera.mounting.closed import scale_of, turns
from ibrobot_camera.mounting.fit import USUAL, Fit, Session
from ibrobot_camera.mounting.shots import scaled, with_joints
from ibrobot_core.api import SensorError

FEWEST, FEWEST_MEASURED = 8, 3
"""Pictures that are needed, and those if the place of the board was measured."""
LEAST_TURN_DEG = 20.0
"""Least angle between two of the poses."""
LEAST_SECOND_DEG = 4.0
"""Least mean angle about a second axis."""
LEAST_USED = 0.65
"""Least share of the pictures that fit."""
_GOOD = 4.0 / 640
"""Error of seven of ten pictures up to which they surely fit, as a share of the picture's width."""
_EXPLAINS = 0.4
"""An explanation reduces this error to at most this share."""
_LEAST_PART = 4
"""Pictures of a part in which the board may have stood elsewhere."""
_SQUARE, _SURE, _LARGEST, _RESCALED = 0.02, 4.0, 3.0, 4
"""Wrong size of a square from which it is refused, as a share of it, and in standard deviations; the largest factor
that is thought of, and the number of steps in which it is found."""
_FITS_BETTER = 0.8
"""With the right size, the error is at most this share."""


def check_count(shots: int, *, measured: bool, seen: str) -> None:
    """Check that the pictures are enough.

    Args:
        shots: pictures with the board.
        measured: whether the place of the board was measured.
        seen: why other pictures cannot be used, for the message.

    Raises:
        SensorError: if they are too few.
    """
    least = FEWEST_MEASURED if measured else FEWEST
    if shots < least:
        raise SensorError(f"{counted(shots, 'picture')} can be used, at least {least} are needed{seen}")


def check_turns(session: Session) -> None:
    """Check that the arm turns enough, about more than one axis.

    Raises:
        SensorError: if it does not; says what to do.
    """
    if session.board is not None:
        return
    vectors = np.degrees(turns(session.arm))
    largest = float(np.linalg.norm(vectors, axis=1).max())
    if largest < LEAST_TURN_DEG:
        raise SensorError(
            f"the arm turns the {_carried(session)} by at most {largest:.0f} degrees, at least {LEAST_TURN_DEG:g} are "
            "needed: without turns, the position of the camera cannot be determined"
        )
    second = float(np.sqrt(np.linalg.eigvalsh(vectors.T @ vectors / len(vectors))[1]))
    if second < LEAST_SECOND_DEG:
        raise SensorError(
            f"the arm turns the {_carried(session)} about one axis only (about another one by {second:.1f} degrees on "
            f"average, at least {LEAST_SECOND_DEG:g} are needed), so the position along this axis stays unknown: "
            "turn the wrist, too"
        )


def _carried(session: Session) -> str:
    return "camera or the board" if session.chain.names else "camera"


def explain(session: Session, fit: Fit) -> None:
    """Raise the reason why pictures and readings contradict each other, if one is found.

    Raises:
        SensorError: with the reason.
    """
    good = _GOOD * session.lens.size[0]
    bad = fit.typical > good or fit.used.mean() < LEAST_USED
    error, reason = min(_explanations(session), key=lambda each: each[0]) if bad else (np.inf, "")
    if error < min(good, _EXPLAINS * fit.typical):
        raise SensorError(reason)
    if session.board is None:
        scale, error = _rescaled(session, fit)
        if abs(scale - 1) > _SQUARE and error < _FITS_BETTER * fit.typical:
            raise SensorError(_square(scale))
    if bad and fit.used.mean() < LEAST_USED:
        raise SensorError(
            f"of {counted(len(fit.used), 'picture')} only {fit.used.sum()} agree with one another: were camera and "
            "board fixed, and are these the joints, the zeros and the URDF of this arm?"
        )


def _square(scale: float) -> str:
    return (
        f"by the motion of the arm, the squares of the board are {scale:.3f} times as large as stated: measure a row "
        "of them, and give the side of one as --square; or calibrate the lens again, if its focal length is wrong"
    )


def _explanations(session: Session) -> Iterator[tuple[float, str]]:
    """What may be wrong, with the error of seven of ten pictures if that is so [px]."""
    chain, shots = session.chain, session.shots
    joints = np.array([shot.joints for shot in shots])
    pairs = zip(chain.names, chain.columns, strict=True)
    for (first, one), (second, two) in combinations(pairs, 2):
        changed = with_joints(shots, {one: joints[:, two], two: joints[:, one]})
        yield (
            _error(Session(changed, chain, session.lens, session.board)),
            f"the pictures fit if the readings of {first} and {second} are exchanged: are their names, or the ids of "
            "their servos?",
        )
    for name, column in zip(chain.names, chain.columns, strict=True):
        changed = with_joints(shots, {column: -joints[:, column]})
        yield (
            _error(Session(changed, chain, session.lens, session.board)),
            f"the pictures fit if {name} turns the other way: is it reversed in the calibration?",
        )
    for at in range(_LEAST_PART, len(shots) - _LEAST_PART + 1):
        rows = np.arange(len(shots)) < at
        errors = np.concatenate([session.some(part).fit().errors for part in (rows, ~rows)])
        yield (
            float(np.quantile(errors, USUAL)),
            f"the pictures before and after {shots[at].name} fit each other, but not together: the board or the camera "
            "has moved there",
        )


def _rescaled(session: Session, fit: Fit) -> tuple[float, float]:
    """The size of the squares by which the pictures fit best, in relation to the stated one, and their error [px]."""
    total = 1.0
    for _ in range(_RESCALED):
        part = session.some(fit.used)
        scale, deviation = scale_of(part.arm, part.seen, fit.camera[:3, :3])
        if abs(scale - 1) < _SURE * deviation or not 1 / _LARGEST < total * scale < _LARGEST:
            break
        total *= scale
        session = Session(scaled(session.shots, scale), session.chain, session.lens)
        fit = session.fit()
    return total, fit.typical


def _error(session: Session) -> float:
    return session.fit().typical
