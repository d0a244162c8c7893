"""The diagnosis: all causes are tested, and those that are accused are ranked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import installed_plugins
from ibrobot_diagnose.cause import ACCUSED, KIND, Cause, CauseDescriptor, Diagnosis, Finding, Reference
from ibrobot_diagnose.causes import all_causes

if TYPE_CHECKING:
    from ibrobot_diagnose.window import Window

_LACKS = {
    "state": "no joint positions were recorded", "commands": "no commands were recorded",
    "answers": "no answers of a model were recorded", "chunks": "no answer of the model was used",
    "pictures": "no pictures were recorded", "guard": "the robot had no guard", "outcome": "nobody judged the outcome",
    "card": "there is no card of the model's data: --data",
    "card pictures": "there is no card of the model's pictures: --data",
    "motion": "the arm stands still", "rig": "this is no rig at rest",
    "rig card": "there is no reference of the rig: `ibrobot preflight --take`",
    "training card": "there is no card from a training", "model": "the model was not asked: --model",
}  # fmt: skip
STREAMS = frozenset({*_LACKS, "demonstration"})
"""Names of all that a cause can need."""


def installed_causes() -> tuple[Cause, ...]:
    """The causes of this package and of others.

    Raises:
        IbrobotError: if one has the name of another.
    """
    known = {each.name: each for each in all_causes()}
    for descriptor in installed_plugins().of_kind(KIND):
        assert isinstance(descriptor, CauseDescriptor)
        cause = descriptor.make()
        if cause.name in known:
            raise IbrobotError(f"there is a cause {cause.name!r} already; the plugin must give its own another name")
        known[cause.name] = cause
    return tuple(known.values())


def diagnose(
    window: Window, reference: Reference, causes: Iterable[Cause] | None = None,
    tested: Callable[[str], None] = lambda name: None,
) -> Diagnosis:  # fmt: skip
    """Test all causes, and rank those that are accused.

    Args:
        window: what happened.
        reference: what it is compared with.
        causes: by default all installed ones.
        tested: called with the name of each cause after its test.
    """
    there = window.streams | reference.streams
    findings: list[Finding] = []
    healthy, untested, measured = [], [], []
    for cause in installed_causes() if causes is None else causes:
        if (cause.needs - there) & {"demonstration", "motion", "rig"}:
            continue  # it is about another kind of window
        if lacking := sorted(cause.needs - there):
            untested.append((cause.name, _LACKS.get(lacking[0], lacking[0])))
            continue
        evidence = cause.test(window, reference)
        if evidence is not None and evidence.likelihood >= ACCUSED:
            findings.append(Finding(cause, evidence))
        else:
            healthy.append((cause.name, cause.title))
            if evidence is not None:
                measured.append(Finding(cause, evidence))
        tested(cause.name)
    return Diagnosis(ranked(findings), tuple(healthy), tuple(untested), tuple(measured))


def ranked(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings by likelihood, each after those that explain it; what explains another is at least as likely.

    Except for a weak policy: that one errs does not make it likelier that nothing is wrong with the set-up.
    """
    likely = {
        each.name: max(
            other.evidence.likelihood
            for other in findings
            if other is each or (each.explains(other) and not each.cause.weak)
        )
        for each in findings
    }
    rest = sorted(findings, key=lambda each: (-likely[each.name], each.name))
    ordered: list[Finding] = []
    while rest:
        free = [each for each in rest if not any(other.explains(each) for other in rest if other is not each)]
        # Two that explain each other: the one that explains more.
        chosen = free[0] if free else max(rest, key=lambda each: sum(map(each.explains, rest)))
        ordered.append(chosen)
        rest.remove(chosen)
    return tuple(ordered)
