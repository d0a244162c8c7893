"""The section `preflight`: before anything moves, a run compares its rig with a reference."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, override

from ibrobot_provenance.recorded_names import CARD

from ibrobot_core.api import HardwareError, IbrobotError, ns
from ibrobot_core.app import CONTROL, Component, RobotConfig, RunView
from ibrobot_diagnose.options import SECTION, PreflightSection
from ibrobot_diagnose.references import RIG


def reference_for(config: RobotConfig) -> Path | None:
    """The reference that a run of this robot is compared with if its section names none; None if there is none.

    It is that of the dataset that the run records into, or of the checkpoint that its first mode runs.
    """
    if config.recording is not None and (taken := config.recording.folder / RIG).is_file():
        return taken
    mode = config.control_modes.get(config.default_control_mode)
    if mode is None or mode.inference is None:
        return None
    model = (config.document.get("models") or {}).get(mode.inference.model)
    path = model.get("path") if isinstance(model, dict) else None
    known = Path(path) / CARD if isinstance(path, str | os.PathLike) else None
    return known if known is not None and known.is_file() else None


def compares(config: RobotConfig) -> bool:
    """Whether a run compares its rig without a section: on hardware, if there is a reference."""
    return not config.simulated and reference_for(config) is not None


class RigCheck(Component):
    """Compares the rig with its reference when it starts, before the mode begins to move the robot."""

    def __init__(self, options: PreflightSection | None, session: RunView) -> None:
        config = session.config
        self._options = options or PreflightSection()
        self._asked = options is not None
        self._session = session
        self._against = self._options.against or reference_for(config)
        self._takes = None
        if self._asked and self._options.action != "off" and self._against is None and config.recording is not None:
            self._takes = config.recording.folder / RIG
        what = f"compares the rig with {self._against}" if self._against else "nothing to compare the rig with"
        if self._takes is not None:
            what = f"takes the reference {self._takes}"
        if self._options.action == "off":
            what = "off"
        sensors = (f"sensor:{name}" for name in config.peripherals if name not in {e.name for e in session.absent})
        super().__init__(SECTION, what, (CONTROL, *sensors))

    @override
    def start(self) -> None:
        if self._options.action == "off":
            return
        if self._against is None and self._takes is None:
            if self._asked:
                self._session.log.warning(
                    "preflight: there is no reference, so the rig is not compared; take one with `ibrobot preflight "
                    "ROBOT --take FILE`, and name it in `against`"
                )
            return
        try:
            self._compare()
        except Refused:
            raise
        except (IbrobotError, OSError) as error:
            if self._options.against is not None or self._options.action == "refuse":
                raise
            self._session.log.warning("preflight: the rig was not compared: %s", error)

    def _compare(self) -> None:
        from ibrobot_diagnose.card import make_card
        from ibrobot_diagnose.preflight import compared
        from ibrobot_diagnose.references import reference_of

        session = self._session
        card = reference_of(self._against) if self._against is not None else None
        window = self._looked() if session.request.lockstep else self._watched()
        if self._takes is not None:
            self._takes.parent.mkdir(parents=True, exist_ok=True)
            make_card([window.window]).write(self._takes)
            session.log.info("preflight: took the reference %s", self._takes)
        result = compared(window, session.config, card)
        for line in result.lines():
            if not line.startswith(("ok", "note")):
                log = session.log.info if result.verdict == "ok" else session.log.warning
                log("preflight: %s", line.strip())
        if result.verdict == "fail" and self._options.action == "refuse":
            worst = result.findings[0]
            raise Refused(f"{worst.evidence.text} {worst.cause.remedy}")

    def _looked(self) -> Any:
        """A window on another simulation with the same seed: time does not pass in a run in lockstep that starts."""
        from ibrobot_diagnose.live import look

        request = self._session.request
        return look(self._session.config, self._options.seconds, lockstep=True, seed=request.seed)

    def _watched(self) -> Any:
        """A window on the run, which does not move yet."""
        from ibrobot_diagnose.watch import POLL_S, SETTLE_S, Watch

        session, watch = self._session, Watch(self._session)
        try:
            for seconds in (SETTLE_S, self._options.seconds):
                watch.begin()
                until_ns = session.clock.now_ns() + ns(seconds)
                while session.clock.now_ns() < until_ns:
                    if session.finished.wait(POLL_S):
                        raise HardwareError("the run ended")
                    watch.take()
            return watch.window()
        finally:
            watch.close()

    @override
    def stop(self) -> None:
        """There is nothing to stop."""


class Refused(IbrobotError):
    """The rig is not what it was, and the robot YAML asks to refuse that."""
