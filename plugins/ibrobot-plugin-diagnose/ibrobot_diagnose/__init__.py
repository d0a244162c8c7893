"""The plugin's hooks: `ibrobot explain`, `datasets check` and `datasets card`.

Causes are classes, see `cause`; other packages add theirs by the hook `ibrobot_causes`, which this plugin defines.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import attrs
from ibrobot_provenance.reports import ReportDescriptor
from ibrobot_provenance.work import Work, Workplace, some_options
from ibrobot_terminal import GuideDescriptor

from ibrobot_core.api import Descriptor, Late, hookimpl
from ibrobot_core.app import Command, Kind, SectionDescriptor
from ibrobot_diagnose.cause import ARM_VIEW, DEVICE_POSE, KIND, CauseDescriptor
from ibrobot_diagnose.options import (
    CHECK,
    CHECK_EVENTS,
    CHECK_KIND,
    EVENTS,
    PREFLIGHT,
    PREFLIGHT_EVENTS,
    PREFLIGHT_KIND,
    REPORT,
    SECTION,
    CheckOptions,
    ExplainOptions,
    PreflightSection,
)
from ibrobot_diagnose.options import KIND as REPORT_KIND


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Causes; what draws the arm in a camera, and what tells where a teleoperation device stands."""
    yield Kind(KIND, "ibrobot_causes", CauseDescriptor)
    yield Kind(ARM_VIEW, "ibrobot_arm_views", Descriptor)
    yield Kind(DEVICE_POSE, "ibrobot_device_poses", Descriptor)


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    fakes = "ibrobot_diagnose.testing"
    yield Descriptor(KIND, Late(f"{fakes}:FakeCause"), "a cause with one number")
    yield Descriptor(ARM_VIEW, Late(f"{fakes}:FakeArmView"), "a stripe for an arm")
    yield Descriptor(DEVICE_POSE, Late(f"{fakes}:fake_pose"), "a device that stands in the middle")


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """What compares the rig of a run with a reference, before it moves."""
    yield SectionDescriptor(
        type=SECTION,
        options=PreflightSection,
        make=Late("ibrobot_diagnose.section:RigCheck"),
        without_section=Late("ibrobot_diagnose.section:compares"),
        summary="compares the rig with a reference before a run moves it",
    )


@hookimpl(optionalhook=True)
def ibrobot_guides() -> Iterable[GuideDescriptor]:
    """A camera that has moved, with the pictures of then and now."""
    yield GuideDescriptor(
        "refit",
        order=80,
        label="Put a camera back",
        summary="Show what a camera sees over what it saw in a reference of `ibrobot preflight`, until it fits again.",
        make=Late("ibrobot_diagnose.refit:refit"),
        questions=Late("ibrobot_diagnose.refit:questions"),
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot explain`, `ibrobot datasets check` and `ibrobot datasets card`."""
    summary = "Say why a recorded run of a policy failed."
    yield Command("datasets card", Late("ibrobot_diagnose.commands.card:MakeCard"))
    check = Late("ibrobot_diagnose.commands.check:CheckDataset")
    yield Command("datasets check", check, "Check each episode of a dataset.", CHECK_EVENTS)
    preflight = Late("ibrobot_diagnose.commands.preflight:Preflight")
    yield Command("preflight", preflight, "Say whether a rig is what it was.", PREFLIGHT_EVENTS)
    yield Command("explain", Late("ibrobot_diagnose.commands.explain:Explain"), summary, EVENTS)


def _is_explanation(folder: Path) -> bool:
    return (folder / REPORT).is_file()


def _is_check(folder: Path) -> bool:
    return (folder / CHECK).is_file()


def _is_preflight(folder: Path) -> bool:
    return (folder / PREFLIGHT).is_file()


def _explained(wanted: Any, place: Workplace) -> ExplainOptions:
    return ExplainOptions(jobs=1, out=place.out, **attrs.asdict(wanted, recurse=False))


def _checked(wanted: Any, place: Workplace) -> CheckOptions:
    return CheckOptions(jobs=1, out=place.out, **attrs.asdict(wanted, recurse=False))


@hookimpl
def ibrobot_reports() -> Iterable[ReportDescriptor]:
    """Explanations, checks of datasets, and preflights."""
    contents = "ibrobot_diagnose.contents"
    yield ReportDescriptor(
        REPORT_KIND,
        summary="Why runs of a policy failed.",
        label="Explanations",
        command="explain",
        reads=_is_explanation,
        lines=Late(f"{contents}:lines_of"),
        make=Late(f"{contents}:read_contents"),
        work=Work(
            "explain",
            "Say why a recorded run of a policy failed.",
            some_options(ExplainOptions, "episodes", "data", "against"),
            _explained,
        ),
    )
    checks = "ibrobot_diagnose.check_contents"
    yield ReportDescriptor(
        CHECK_KIND,
        summary="Episodes of datasets to look at.",
        label="Checks",
        command="datasets check",
        reads=_is_check,
        lines=Late(f"{checks}:lines_of"),
        make=Late(f"{checks}:read_contents"),
        work=Work(
            "check_dataset",
            "Say which episodes of a dataset to look at, and why.",
            some_options(CheckOptions, "dataset", "least"),
            _checked,
        ),
    )
    preflights = "ibrobot_diagnose.preflight_contents"
    yield ReportDescriptor(
        PREFLIGHT_KIND,
        summary="Whether a rig is what it was.",
        label="Preflights",
        command="preflight",
        reads=_is_preflight,
        lines=Late(f"{preflights}:lines_of"),
        make=Late(f"{preflights}:read_contents"),
    )
