"""Quality tools of other projects as causes, each where its package is installed: lerobot-doctor and lerobot-lint.

They judge an episode by itself. Their thresholds are their own; that one of them flags an episode is the evidence.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, override

import numpy as np

from ibrobot_diagnose.cause import Cause, Evidence, Reference
from ibrobot_diagnose.window import Floats, Window

_FLAGGED = 0.6
"""Likelihood of an episode that another tool flags: our own causes say how sure they are, and come first."""
_SHOWN = 5


class _Tool(Cause):
    """A tool of another project."""

    needs = frozenset({"demonstration", "state", "commands"})
    package: ClassVar[str]
    remedy = "Look at the episode; what the tool means by its words is described in its documentation."

    @abstractmethod
    def reasons(self, window: Window, states: Floats, actions: Floats) -> Sequence[str]:
        """Why the tool flags an episode, from states and actions at the ticks [rad], shape (T, J); else empty."""

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        known = np.isfinite(window.states).all(axis=1) & np.isfinite(window.commands).all(axis=1)
        if known.sum() < 2:
            return None
        with np.errstate(all="ignore"):  # lerobot-lint divides by the deviation of a joint that stands still
            reasons = self.reasons(window, window.states[known], window.commands[known])
        text = f"{self.package} {version(self.package)} flags this episode: {reasons[0]}." if reasons else ""
        likely = _FLAGGED if reasons else 0.0
        return Evidence(text, float(len(reasons)), "reasons", 1.0, likely, details=tuple(reasons[1:_SHOWN]))


class LerobotDoctor(_Tool):
    """What lerobot-doctor says of an episode."""

    name, title, package = "lerobot_doctor", "lerobot-doctor flags nothing in the episode", "lerobot-doctor"

    @override
    def reasons(self, window: Window, states: Floats, actions: Floats) -> Sequence[str]:
        from lerobot_doctor.checks.per_episode import check_per_episode
        from lerobot_doctor.dataset_loader import DatasetInfo, EpisodeData, LoadedDataset

        rate = window.contract.rate_hz
        columns = {"timestamp": np.arange(len(states)) / rate, "observation.state": states, "action": actions}
        dataset = LoadedDataset(
            Path(),
            info=DatasetInfo({}, Path(), fps=round(rate)),
            episodes_data=[EpisodeData(0, columns, len(states))],
        )
        said = [str(each.message) for each in check_per_episode(dataset).messages]
        return [reason for each in said if each.startswith("Episode 0: ") for reason in each[11:].split("; ")]


@cache
def _checks_of_lint(joints: tuple[str, ...]) -> Any:
    from lerobot_lint.config import detect_profile_name, load_profile
    from lerobot_lint.engine import build_episode_check_registry

    return build_episode_check_registry(load_profile(detect_profile_name(list(joints)) or "default"))


class LerobotLint(_Tool):
    """What lerobot-lint says of an episode."""

    name, title, package = "lerobot_lint", "lerobot-lint flags nothing in the episode", "lerobot-lint"

    @override
    def reasons(self, window: Window, states: Floats, actions: Floats) -> Sequence[str]:
        from lerobot_lint.types import EpisodeData

        rate = window.contract.rate_hz
        times = np.arange(len(states)) / rate
        episode = EpisodeData(
            states.astype(np.float32), actions.astype(np.float32), times, rate, window.prompt, camera_handles={}
        )
        flags = _checks_of_lint(window.joints).run_all(episode, 0)
        return [f"{each.check}: {each.message}" for each in flags if each.severity in ("error", "warning")]


TOOLS: tuple[type[_Tool], ...] = (LerobotDoctor, LerobotLint)
CAUSES: tuple[type[Cause], ...] = tuple(each for each in TOOLS if find_spec(each.package.replace("-", "_")) is not None)
