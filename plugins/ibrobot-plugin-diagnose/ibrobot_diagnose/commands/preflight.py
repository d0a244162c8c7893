"""`ibrobot preflight`: whether a rig is what it was."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.app import (
    Emit,
    RequestError,
    RobotConfig,
    Unsuccessful,
    echo,
    find_config,
    installed_plugins,
    load_config,
    wrong_input,
)
from ibrobot_diagnose.options import Looking, PreflightOptions
from ibrobot_diagnose.references import reference_of

if TYPE_CHECKING:
    from ibrobot_diagnose.card import Card
    from ibrobot_diagnose.preflight import Preflight as Result


@attrs.frozen(kw_only=True)
class Preflight(PreflightOptions):
    """Look at a ROBOT at rest, and say what differs from a reference; nothing moves, but its arms hold their pose.

    Each line has a number, the numbers from which it warns and fails, and what to do. --take writes the reference: a
    still of each camera with the pose of the arm, rates, calibration and versions. Datasets and checkpoints have one,
    too. Exits with 1 if a line fails.
    """

    @wrong_input()
    def __call__(self, emit: Emit) -> dict[str, Any] | None:
        if self.against is not None and self.take is not None:
            raise RequestError("--against and --take exclude each other: a reference is compared with, or taken")
        if self.take is not None and self.take.is_dir():
            raise RequestError(f"--take {self.take}: is a folder; name the file of the reference")
        if self.out is not None and self.out.exists() and not self.out.is_dir():
            raise RequestError(f"--out {self.out}: is a file; name a folder")
        if self.lockstep and not self.sim:
            raise RequestError("--lockstep is for simulation: add --sim")
        config = load_config(
            find_config(self.robot, installed_plugins()), overrides=self.overrides, mode=self.mode, sim=self.sim
        )
        card = reference_of(self.against) if self.against is not None else None
        result = _looked(self, config, card, emit)
        facts = result.facts()
        if emit is not None:
            for event in result.events(self.out):
                emit(event)
        if facts["verdict"] == "fail":
            raise Unsuccessful(None if emit is not None else facts)
        return None if emit is not None else facts

    def show(self, facts: dict[str, Any]) -> None:
        """Print the lines."""
        for line in facts["lines_of_text"]:
            echo(line)


def _looked(options: PreflightOptions, config: RobotConfig, card: Card | None, emit: Emit) -> Result:
    from ibrobot_diagnose.card import make_card
    from ibrobot_diagnose.live import look
    from ibrobot_diagnose.preflight import compared

    def tell(what: str) -> None:
        if emit is not None:
            emit(Looking(what=what))

    seen = look(config, options.seconds, lockstep=options.lockstep, tell=tell)
    result = compared(seen, config, card)
    if options.take is not None:
        make_card([seen.window]).write(options.take)
        result = result.taken(options.take)
    if options.out is not None:
        result.write(options.out)
    return result
