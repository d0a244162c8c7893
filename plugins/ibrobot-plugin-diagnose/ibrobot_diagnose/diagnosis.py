"""The diagnosis: all causes are tested, and those that are accused are ranked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from pathlib import Path
from traceback import extract_tb
from typing import TYPE_CHECKING, Any

import attrs

from ibrobot_core.app import installed_plugins
from ibrobot_diagnose.cause import ACCUSED, KIND, Cause, CauseDescriptor, Diagnosis, Evidence, Finding, Reference
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
_OF_ANOTHER_KIND = frozenset({"demonstration", "motion", "rig"})
"""What a window of the wrong kind lacks."""
_OF_RUNS = frozenset({"answers", "chunks", "outcome", "model", "training card"})
"""What a rig at rest always lacks, since no policy runs."""


@attrs.frozen
class Installed:
    """The causes of this package and of others."""

    causes: tuple[Cause, ...]
    broken: tuple[tuple[str, str], ...]
    """Type of the causes that cannot be used, and name of the plugins that failed: with the package and the mistake."""
    packages: Mapping[str, str]
    """Name of a cause -> its package."""


def installed_causes() -> Installed:
    """The causes of this package and of others. A mistake in one keeps the others."""
    registry = installed_plugins()
    causes = list(all_causes())
    packages = dict.fromkeys((each.name for each in causes), "ibrobot-plugin-diagnose")
    broken = [(failure.plugin, str(failure)) for failure in registry.failures]
    for descriptor in registry.of_kind(KIND):
        assert isinstance(descriptor, CauseDescriptor)
        package = registry.entries[KIND, descriptor.type].package
        try:
            cause = descriptor.make()
            mistakes = list(_mistakes(cause, descriptor))
        except Exception as error:  # noqa: BLE001 - contained: the other causes are tested
            mistakes = [f"it cannot be made: {_said(error)}"]
        if mistakes:
            broken.append((descriptor.type, f"{package} has a mistake: {'; '.join(mistakes)}"))
        else:
            causes.append(cause)
            packages[cause.name] = package
    return Installed(tuple(causes), tuple(broken), packages)


def _mistakes(cause: object, descriptor: CauseDescriptor) -> Iterator[str]:
    """What keeps a cause of another package from being used."""
    if not isinstance(cause, Cause):
        yield f"make returned {cause!r}, must be a Cause"
        return
    given = {name: value for base in reversed(type(cause).__mro__) for name, value in vars(base).items()}
    given |= vars(cause)
    for name in ("name", "title", "remedy"):
        if not isinstance(value := given.get(name), str):
            yield f"its {name} is no text: {value!r}"
            return
    if cause.name != descriptor.type:
        yield f"its name is {cause.name!r}, and the type of its descriptor {descriptor.type!r}: give both one name"
    for name in ("needs", "explains"):
        value = getattr(cause, name)
        if not isinstance(value, Set) or not all(isinstance(each, str) for each in value):
            yield f"its {name} are no frozenset of texts: {value!r}"
        elif name == "needs" and (unknown := sorted(value - STREAMS)):
            yield f"it needs {', '.join(unknown)}; available: {', '.join(sorted(STREAMS))}"


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".replace("\n", " ").strip()


def _raised(error: Exception, cause: Cause) -> str:
    """What a test of a cause raised, and the line of its package where that happened."""
    package = type(cause).__module__.partition(".")[0]
    frames = [each for each in extract_tb(error.__traceback__) if package in Path(each.filename).parts]
    place = f" ({'/'.join(Path(frames[-1].filename).parts[-2:])}:{frames[-1].lineno})" if frames else ""
    return f"{_said(error)}{place}"


def diagnose(
    window: Window, reference: Reference, causes: Iterable[Cause] | None = None,
    tested: Callable[[str], None] = lambda name: None,
) -> Diagnosis:  # fmt: skip
    """Test all causes, and rank those that are accused.

    Args:
        window: what happened.
        reference: what it is compared with.
        causes: those to test, which raise what they raise; by default all installed ones, whose mistakes are listed.
        tested: called with the name of each cause after its test.
    """
    there = window.streams | reference.streams
    elsewhere = _OF_ANOTHER_KIND | _OF_RUNS if window.rig is not None else _OF_ANOTHER_KIND
    findings: list[Finding] = []
    healthy, untested, measured = [], [], []
    installed = installed_causes() if causes is None else Installed(tuple(causes), (), {})
    broken = list(installed.broken)
    for cause in installed.causes:
        if (cause.needs - there) & elsewhere:
            continue  # it is about another kind of window
        if lacking := cause.needs - there:  # what was not recorded says more than what was not given
            untested.append((cause.name, next(why for name, why in _LACKS.items() if name in lacking)))
            continue
        try:
            evidence: Any = cause.test(window, reference)
            if not isinstance(evidence, Evidence | None):
                raise TypeError(f"test returned {evidence!r}: return an Evidence, or None")
        except Exception as error:
            if causes is not None:
                raise
            broken.append((cause.name, f"{installed.packages[cause.name]} has a mistake: {_raised(error, cause)}"))
            continue
        if evidence is not None and evidence.likelihood >= ACCUSED:
            findings.append(Finding(cause, evidence))
        else:
            healthy.append((cause.name, cause.title))
            if evidence is not None:
                measured.append(Finding(cause, evidence))
        tested(cause.name)
    untested += broken
    return Diagnosis(ranked(findings), tuple(healthy), tuple(untested), tuple(measured), tuple(broken))


def ranked(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Findings by likelihood, each after those that explain it; what explains another is at least as likely.

    A weak policy comes last: that one errs does not make it likelier that nothing is wrong with the set-up.
    """
    likely = {
        each.name: max(
            other.evidence.likelihood
            for other in findings
            if other is each or (each.explains(other) and not each.cause.weak)
        )
        for each in findings
    }
    rest = sorted(findings, key=lambda each: (each.cause.weak, -likely[each.name], each.name))
    ordered: list[Finding] = []
    while rest:
        free = [each for each in rest if not any(other.explains(each) for other in rest if other is not each)]
        # Two that explain each other: the one that explains more.
        chosen = free[0] if free else max(rest, key=lambda each: sum(map(each.explains, rest)))
        ordered.append(chosen)
        rest.remove(chosen)
    return tuple(ordered)
