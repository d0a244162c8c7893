"""The hooks: the terminal of runs, lists of plugins, and the kinds of guides and of tables about a run."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from ibrobot_core.api import Descriptor, Late, hookimpl
from ibrobot_core.app import Command, Kind
from ibrobot_terminal.guide import GuideDescriptor, PanelDescriptor


@hookimpl
def ibrobot_kinds() -> Iterable[Kind]:
    """Guides for operators, and tables about a run."""
    yield Kind("guide", "ibrobot_guides", GuideDescriptor)
    yield Kind("panel", "ibrobot_panels", PanelDescriptor)


@hookimpl
def ibrobot_terminals() -> Iterable[Descriptor[Any]]:
    """Keys and panel."""
    yield Descriptor(
        type="panel",
        make=lambda options, ctx: Late("ibrobot_terminal.run_terminal:PanelTerminal")(),
        summary="reads the terminal's keys, and shows a live panel",
        default=True,
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Lists of what is installed."""
    summary = "List what the installed plugins offer."
    yield Command("plugins", Late("ibrobot_terminal.plugin_lists:ListPlugins"), summary)
    yield Command("plugins show", Late("ibrobot_terminal.plugin_lists:ShowPlugin"))


@hookimpl(optionalhook=True)
def ibrobot_samples() -> Iterable[Descriptor[Any]]:
    """What `ibrobot plugins new` begins with."""
    yield Descriptor("guide", Late("ibrobot_terminal.fakes:fake_guide"), "a guide with a question and a table")
    yield Descriptor("panel", Late("ibrobot_terminal.fakes:fake_panel"), "a table of the joints of a run")
