"""A diagnosis in words, and as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import attrs
import numpy as np
from ibrobot_terminal.plural import counted

from ibrobot_diagnose.cause import Diagnosis, Finding, Reference
from ibrobot_diagnose.course import Course, course_of
from ibrobot_diagnose.window import Window

_LEAST = 5e-5
"""Least mean difference that is shown in words [rad]."""
_MOVES = 5e-4
"""Least motion of an answer that is shown in words [rad]."""


@attrs.frozen(eq=False)
class Explanation:
    """A window with its diagnosis."""

    window: Window
    reference: Reference
    diagnosis: Diagnosis
    course: Course | None

    @classmethod
    def of(cls, window: Window, reference: Reference, diagnosis: Diagnosis) -> Explanation:
        """An explanation."""
        return cls(window, reference, diagnosis, course_of(window))

    @property
    def first(self) -> str:
        """The first line: the most probable cause, or that none was found, and why."""
        diagnosis, outcome = self.diagnosis, self.window.outcome
        tested = len(diagnosis.healthy)
        if diagnosis.findings:
            first = diagnosis.findings[0]
            if not first.cause.weak:
                return first.evidence.text
            if outcome == "success":
                return f"Nothing is wrong: the run is a success, though {first.evidence.text}"
            return f"Nothing is wrong with the set-up; more or better data is what helps: {first.evidence.text}"
        lacking = sum("--data" in why for _, why in diagnosis.untested)
        if outcome == "success":
            return f"Nothing is wrong: the run is a success, and none of the {tested} causes tested was found."
        if lacking:
            return (
                f"None of the {tested} causes that could be tested was found; {lacking} more can be with "
                "--data DATASET, the data that the model was trained on."
            )
        return (
            f"Nothing is wrong with the set-up; more or better data is what helps: none of the {tested} causes tested "
            "was found, so the model got what it was trained on and the arm did what it said."
        )

    def to_do(self, number: int) -> str:
        """What to do about a finding: its remedy, or first that of the finding that causes it."""
        findings = self.diagnosis.findings
        remedy = findings[number].cause.remedy
        if (source := self.diagnosis.source_of(number)) is not None:
            first = "the first cause" if not source else f"cause {source + 1}"
            return f"Fix {first} first: this is probably a consequence of it."
        if number and findings[number].cause.weak and not findings[0].cause.weak:
            return f"Fix the first cause first. If the policy still fails then: {remedy}"
        return remedy

    def facts(self, *, ticks: bool = False) -> dict[str, Any]:
        """The explanation as a JSON object."""
        diagnosis, window = self.diagnosis, self.window
        return {
            "episode": window.name, "outcome": window.outcome, "seconds": round(window.seconds, 3), "first": self.first,
            "causes": [
                {**finding_facts(each), "to_do": self.to_do(number)} for number, each in enumerate(diagnosis.findings)
            ],
            "healthy": [{"name": name, "text": title} for name, title in diagnosis.healthy],
            "untested": [{"name": name, "why": why} for name, why in diagnosis.untested],
            "between": between(window, self.course), **self._model_facts(),
            **({"ticks": self.course.table()} if ticks and self.course is not None else {}),
        }  # fmt: skip

    def _model_facts(self) -> dict[str, Any]:
        model = self.reference.model
        if model is None:
            return {}
        return {
            "model": {
                "asked": len(model.again), "equal": sum(each.equal for each in model.again), "whose": model.whose,
                "identity": model.identity,
                "effects": [
                    {"what": each.what, "change": each.change, "rad": {k: _plain(v) for k, v in each.per_joint.items()}}
                    for each in model.effects
                ],
            }
        }  # fmt: skip

    def _model_lines(self) -> list[str]:
        model = self.reference.model
        if model is None:
            return []
        equal = sum(each.equal for each in model.again)
        counts = f"{equal} of {len(model.again)} answers are equal, bit for bit"
        lines = [f"The model asked again ({model.identity or 'here'}): {counts}."]
        lines += [f"   The first difference: {model.whose}."] if model.whose else []
        shown = [
            f"{each.what} {each.change} {each.largest:.3f} rad" for each in model.effects if each.largest >= _MOVES
        ]
        if shown:
            lines.append(f"How far its answers move: {'; '.join(shown[:12])}.")
        elif model.effects:
            lines.append(f"Its answers stay the same with each of {len(model.effects)} changes of its observations.")
        return lines

    def lines_between(self) -> list[str]:
        """What happened between the model's answers and the arm, and how the model answers now, in words."""
        return [*between_lines(self.window, self.course), *self._model_lines()]

    def lines(self) -> list[str]:
        """The explanation for a terminal."""
        diagnosis, lines = self.diagnosis, [self.first]
        for number, each in enumerate(diagnosis.findings):
            evidence = each.evidence
            if number:
                lines += ["", f"{number + 1}. {evidence.text}"]
            since = f", from {evidence.since_s:.1f} s on" if evidence.since_s is not None else ""
            lines += [f"   likelihood {100 * evidence.likelihood:.0f} %{since} ({each.name})"]
            lines += [f"   {detail}" for detail in evidence.details]
            lines += [f"   What to do: {self.to_do(number)}"]
        lines += ["", *self.lines_between()]
        if diagnosis.healthy:
            lines += [f"Tested and healthy: {'; '.join(title for _, title in diagnosis.healthy)}."]
        reasons = Counter(why for _, why in diagnosis.untested)
        names: dict[str, list[str]] = {}
        for name, why in diagnosis.untested:
            names.setdefault(why, []).append(name)
        lines += [f"Not tested, since {why}: {', '.join(names[why])}." for why in reasons]
        return lines


def finding_facts(each: Finding) -> dict[str, Any]:
    """A finding as a JSON object."""
    evidence = each.evidence
    return {
        "name": each.name, "text": evidence.text, "number": _plain(evidence.number), "unit": evidence.unit,
        "threshold": _plain(evidence.threshold), "likelihood": round(evidence.likelihood, 4),
        "since_s": None if evidence.since_s is None else round(evidence.since_s, 3), "details": list(evidence.details),
        "remedy": each.cause.remedy, "mends": each.cause.mends,
    }  # fmt: skip


def _plain(value: float) -> float:
    return float(f"{value:.6g}")


def between(window: Window, course: Course | None) -> Mapping[str, Any]:
    """What happened between the model's answers and the arm, over the run."""
    used = [each for each in window.asked if each.used]
    facts: dict[str, Any] = {
        "requests": len(window.asked), "used": len(used),
        "failed": sum(bool(each.answer.error) for each in window.asked),
        "late": sum(each.answer.outcome == "late" for each in window.asked),
    }  # fmt: skip
    if used:
        facts["latency_ms"] = round(float(np.median([each.answer.latency_ms for each in used])), 2)
        facts["past_actions"] = round(float(np.mean([each.past for each in used])), 2)
        facts["chunk_actions"] = round(float(np.mean([len(each.chunk) for each in used])), 2)
        facts["step_ms"] = round(float(np.median([each.answer.step_ns for each in used])) / 1e6, 3)
    if course is not None:
        facts |= {
            "share_held": round(float((course.dry & ~course.operated).mean()), 4),
            "share_operated": round(float(course.operated.mean()), 4),
            "share_at_limit": {
                name: round(float(flags.any(axis=1).mean()), 4) for name, flags in course.at_limits.items()
            },
            "mean_difference_rad": {name: round(value, 5) for name, value in course.shares.items()},
        }
    gaps = np.diff(window.command.times_ns) / 1e6
    if len(gaps):
        facts["command_period_ms"] = round(float(np.median(gaps)), 3)
        facts["longest_pause_ms"] = round(float(gaps.max()), 2)
    return facts


def between_lines(window: Window, course: Course | None) -> list[str]:
    """The same in words."""
    facts = between(window, course)
    if not facts["used"]:
        return ["No answer of a model was used in this recording."] if window.asked else []
    lines = [
        f"Between answer and arm: {counted(facts['requests'], 'request')}, {facts['used']} used, {facts['late']} late, "
        f"{facts['failed']} failed; {facts['latency_ms']:.0f} ms for an answer, {facts['past_actions']:.1f} of "
        f"{facts['chunk_actions']:.0f} actions past when it came."
    ]
    if course is not None:
        shares = facts["mean_difference_rad"]
        total = sum(shares.values()) or 1.0
        parts = [
            f"{name} {value:.4f} rad ({100 * value / total:.0f} %)" for name, value in shares.items() if value >= _LEAST
        ]
        lines.append(f"Mean difference from the newest answer to the arm: {', '.join(parts) or 'none'}.")
        times = {
            "held without a plan": facts["share_held"], "moved by an operator": facts["share_operated"],
            **{f"at the {name} limit": share for name, share in facts["share_at_limit"].items()},
        }  # fmt: skip
        if spent := [f"{what} {100 * share:.1f} %" for what, share in times.items() if share]:
            lines.append(f"Share of the time: {', '.join(spent)}.")
    return lines
