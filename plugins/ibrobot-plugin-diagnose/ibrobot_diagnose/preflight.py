"""The comparison of a live rig with a reference, as lines with a verdict each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.plural import measured

from ibrobot_core.app import Event, RobotConfig
from ibrobot_diagnose.arm_view import with_moving
from ibrobot_diagnose.card import Card
from ibrobot_diagnose.cause import Diagnosis, Finding, Reference, Verdict
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.options import Difference, PreflightReport
from ibrobot_diagnose.report import finding_facts
from ibrobot_diagnose.watch import LiveWindow
from ibrobot_diagnose.window import Window

_WORDS: Mapping[Verdict, str] = {"ok": "ok  ", "warn": "warn", "fail": "FAIL", "cannot tell": "?   "}
_COUNTED: Mapping[Verdict, str] = {"ok": "ok", "warn": "warn", "fail": "fail", "cannot tell": "uncertain"}
_ORDER: Sequence[Verdict] = ("fail", "warn", "cannot tell", "ok")


@attrs.frozen(eq=False, slots=False)
class Preflight:
    """A rig, compared with a reference."""

    window: Window
    card: Card | None
    diagnosis: Diagnosis
    notes: tuple[str, ...] = ()
    file: Path | None = None
    """The reference that was taken."""

    def taken(self, file: Path) -> Preflight:
        """The same, with the reference that was written."""
        return attrs.evolve(self, file=file)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What was measured, worst first."""
        listed = (*self.diagnosis.findings, *self.diagnosis.measured)
        return tuple(sorted(listed, key=lambda each: _ORDER.index(each.evidence.verdict)))

    @property
    def verdict(self) -> Verdict:
        """The worst one; what is uncertain is no fault."""
        worst = self.findings[0].evidence.verdict if self.findings else "ok"
        return worst if worst in ("fail", "warn") else "ok"

    @property
    def first(self) -> str:
        """The result in a sentence."""
        robot = self.window.rig.robot if self.window.rig is not None else ""
        counts = {verdict: sum(each.evidence.verdict == verdict for each in self.findings) for verdict in _ORDER}
        told = ", ".join(f"{counts[each]} {_COUNTED[each]}" for each in _ORDER)
        if self.card is None or self.card.rig is None:
            return f"{robot}: {told}; there is no reference to compare with."
        says = {"ok": "is as in the reference", "warn": "is not as in the reference", "fail": "is not fit to be used"}
        taken = f" of {self.card.rig.taken}" if self.card.rig.taken and self.verdict != "fail" else ""
        doubt = ", as far as that is certain" if self.verdict == "ok" and counts["cannot tell"] else ""
        return f"{robot} {says[self.verdict]}{taken}{doubt}: {told}."

    def to_do(self, finding: Finding) -> str:
        """What to do about a finding: its remedy, or first that of the finding that causes it."""
        findings = self.diagnosis.findings
        number = next((i for i, each in enumerate(findings) if each is finding), None)
        source = self.diagnosis.source_of(number) if number is not None else None
        if source is None:
            return finding.cause.remedy
        return f"Fix {findings[source].name} first: this is probably a consequence of it."

    def facts(self) -> dict[str, Any]:
        """The result as a JSON object."""
        return {
            "robot": self.window.name, "verdict": self.verdict, "first": self.first,
            "lines": [{**_line_facts(each), "remedy": self.to_do(each)} for each in self.findings],
            "untested": [{"name": name, "why": why} for name, why in self.diagnosis.untested],
            "notes": list(self.notes), "taken": str(self.file or ""), "lines_of_text": self.lines(),
        }  # fmt: skip

    def events(self, out: Path | None) -> Iterator[Event]:
        """The result as events: each difference, worst first, and the report in a folder."""
        for each in self.findings:
            if each.evidence.verdict in ("fail", "warn"):
                yield Difference(
                    name=each.name, verdict=each.evidence.verdict, text=each.evidence.text, limits=_limits(each),
                    remedy=self.to_do(each),
                )  # fmt: skip
        yield PreflightReport(verdict=self.verdict, lines=tuple(self.lines()), out=str(out or ""))

    def lines(self) -> list[str]:
        """The result for a terminal."""
        lines = []
        for each in self.findings:
            evidence = each.evidence
            lines.append(f"{_WORDS[evidence.verdict]}  {each.name}: {_says(each)} {_limits(each)}".rstrip())
            if evidence.verdict != "ok":
                lines += [f"      {detail}" for detail in evidence.details]
            if evidence.verdict in ("warn", "fail"):
                lines.append(f"      What to do: {self.to_do(each)}")
        lines += [f"note  {note}" for note in self.notes]
        lines += [f"note  {name} was not tested: {why}" for name, why in self.diagnosis.broken]
        lines.append(self.first)
        if self.file is not None:
            lines.append(f"reference -> {self.file}")
        return lines

    def write(self, out: Path) -> None:
        """Write the report as JSON and as one HTML file into a folder."""
        from ibrobot_diagnose.preflight_contents import write_preflight

        write_preflight(out, self.facts(), self.findings)


def _says(finding: Finding) -> str:
    return finding.cause.title if finding.evidence.verdict == "ok" else finding.evidence.text


def _limits(finding: Finding) -> str:
    evidence = finding.evidence
    if evidence.unclear:
        return ""
    numbers = [f"warns from {evidence.threshold:.3g}"]
    if evidence.fails is not None:
        numbers.append(f"fails from {evidence.fails:.3g}")
    return f"[{measured(evidence.number, evidence.unit)}; {', '.join(numbers)}]"


def _line_facts(finding: Finding) -> dict[str, Any]:
    evidence = finding.evidence
    return {
        **finding_facts(finding), "text": _says(finding), "verdict": evidence.verdict, "fails": evidence.fails,
        "unclear": evidence.unclear,
    }  # fmt: skip


def compared(seen: LiveWindow, config: RobotConfig, card: Card | None) -> Preflight:
    """Compare a rig with a reference; without one, only what it says by itself is tested."""
    window, notes = seen.window, seen.rig.notes
    if card is not None and card.rig is not None:
        now, then, more = with_moving((seen.rig, card.rig), config, seen.infos)
        notes += more
        window, card = attrs.evolve(window, rig=now), attrs.evolve(card, rig=then)
    return Preflight(window, card, diagnose(window, Reference(card)), notes)
