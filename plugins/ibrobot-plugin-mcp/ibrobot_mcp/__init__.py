"""The plugin's hooks: the section `mcp`, and the commands `ibrobot mcp` and `ibrobot agent …`."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import Command, SectionDescriptor
from ibrobot_mcp.options import SECTION, McpOptions


@hookimpl
def ibrobot_sections() -> Iterable[SectionDescriptor]:
    """A door for agents."""
    yield SectionDescriptor(
        type=SECTION,
        options=McpOptions,
        make=Late("ibrobot_mcp.door:AgentDoor"),
        summary="the robot's services as tools of the Model Context Protocol, within what a person grants",
    )


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """`ibrobot mcp` and `ibrobot agent …`."""
    yield Command("mcp", Late("ibrobot_mcp.command:RunMcp"), "Run a robot for an agent, over standard input.")
    yield Command("agent", summary="Let an agent move a robot that runs here, and end that.")
    yield Command("agent add", Late("ibrobot_mcp.commands:AddAgent"))
    yield Command("agent remove", Late("ibrobot_mcp.commands:RemoveAgent"))
    yield Command("agent list", Late("ibrobot_mcp.commands:ListAgents"))
    yield Command("agent arm", Late("ibrobot_mcp.commands:ArmAgent"))
    yield Command("agent disarm", Late("ibrobot_mcp.commands:DisarmAgent"))
    yield Command("agent status", Late("ibrobot_mcp.commands:ShowAgents"))
