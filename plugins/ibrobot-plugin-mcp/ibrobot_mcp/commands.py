"""`ibrobot agent …`: a person grants an agent authority over a robot that runs on this machine, and ends it."""

from __future__ import annotations

import getpass
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import attrs
from ibrobot_terminal.agent_calls import AskedPath
from ibrobot_terminal.questions import confirm

from ibrobot_core.api import IbrobotError, option
from ibrobot_core.app import RequestError, echo
from ibrobot_mcp.persons import ASKED, MOVING, ask, running, sockets_folder
from ibrobot_mcp.tokens import add_token, named_agents, remove_token


@attrs.frozen(kw_only=True)
class _OfRun:
    robot: str = option("", typed="[ROBOT]", help="name of the robot; needed if several run here")

    def path(self) -> Path:
        """The socket of the run.

        Raises:
            RequestError: if there is none, or several.
        """
        sockets = [path for path in running() if self.robot in ("", path.stem)]
        if not sockets:
            named = f" named {self.robot}" if self.robot else ""
            raise RequestError(
                f"no robot{named} with a door for agents runs here: start one by `ibrobot mcp`; each run of yours has "
                f"a socket in {sockets_folder()}, or where its XDG_RUNTIME_DIR says"
            )
        if len(sockets) > 1:
            raise RequestError(f"several run here, name one: {', '.join(path.stem for path in sockets)}")
        return sockets[0]


@attrs.frozen(kw_only=True)
class ArmAgent(_OfRun):
    """Let an agent move the robot, for a time and within a scope.

    The agent may then call the services named by `--allow`, nothing moves faster than `--speed`, and nothing leaves
    `--region`. Esc, a stop on the page, `ibrobot agent disarm`, silence of the agent and the end of the time end it;
    the arm then holds.
    """

    seconds: float = option(300.0, unit="s", gt=0, le=3600, help="how long")
    speed: float = option(0.25, ge=0.01, le=1, help="fraction of the velocity limits")
    allow: tuple[str, ...] = option((), typed="--allow SERVICE", help=f"a service; by default {', '.join(MOVING)}")
    region: tuple[str, ...] = option(
        (), typed="--region PATH=LOW:HIGH,…", help="e.g. tool.position=0.1:0.4,-0.2:0.2,0.0:0.4 [m]"
    )
    lease: float = option(10.0, unit="s", ge=1, le=120, help="longest silence of the agent's program")
    agent: str = option("", typed="--agent NAME", help="the agent; needed if several are connected")
    yes: bool = option(False, typed="--yes", help="do not ask")

    def __call__(self) -> None:
        path = self.path()
        services = list(self.allow or MOVING)
        region = list(map(_bounds, self.region))
        if twice := [name for name, count in Counter(name for name, _ in region).items() if count > 1]:
            raise RequestError(f"--region {twice[0]}: it is given twice")
        agent = self._chosen(ask(path, "/agent/status")["agents"])
        grant = {
            "seconds": self.seconds, "services": services, "speed": self.speed, "lease": self.lease,
            "agent": agent, "region": dict(region), "by": _user(),
        }  # fmt: skip
        echo(f"{agent} on {path.stem}: for {self.seconds:g} s, {self.speed:.0%} of the speed limits")
        echo(f"services: {', '.join(services)}")
        echo(f"region: {', '.join(self.region) or 'no limits but those of the joints'}")
        self._show(agent, path)
        if not self.yes and not confirm("Let the agent move the robot?", flag="--yes"):
            raise IbrobotError("nothing was granted")
        echo(ask(path, "/agent/arm", grant))

    def _show(self, agent: str, path: Path) -> None:
        """Show what the agent asked for last, and how it would move."""
        try:
            asked = ask(path, ASKED)
        except IbrobotError as error:  # a plan may take longer than an answer; the person can decide without it
            echo(f"what it asks for is not known: {error}")
            return
        if asked is None or asked["agent"] != agent or not asked["refused"]:
            return
        echo(f"it asks for: {asked['service']} {asked['request']}")
        echo(f"path: {AskedPath(asked['seconds'], asked['path']).at(self.speed)}")

    def _chosen(self, connected: Sequence[str]) -> str:
        """The name of the agent in this connection, so that no other one gets the grant that the person agrees to."""
        chosen = [each for each in connected if self.agent in ("", each, each.partition(":")[2])]
        if not connected:
            raise RequestError("no agent is connected: start its program, and have it call a tool, e.g. `state`")
        if len(chosen) != 1:
            raise RequestError(f"name one agent by --agent; connected: {', '.join(connected)}")
        return chosen[0]


@attrs.frozen(kw_only=True)
class AddAgent:
    """Make the token of an agent that connects by HTTP. It is shown once, and valid for all robots that you run.

    The agent's program sends it as `Authorization: Bearer TOKEN`. Give each agent one of its own: a grant is for the
    agent whose token it is. `ibrobot agent remove` takes it away.
    """

    name: str = option(typed="NAME", help="how the agent is called, e.g. claude")

    def __call__(self) -> Any:
        return {"agent": self.name, "token": add_token(self.name)}

    def show(self, made: Mapping[str, Any]) -> None:
        """Print it."""
        echo(made["token"])


@attrs.frozen(kw_only=True)
class RemoveAgent:
    """Take away the token of an agent. It is disconnected, and what it was granted ends."""

    name: str = option(typed="NAME", help="the agent")

    def __call__(self) -> None:
        remove_token(self.name)


@attrs.frozen(kw_only=True)
class ListAgents:
    """List the agents that have a token."""

    def __call__(self) -> Any:
        return {"agents": named_agents()}

    def show(self, known: Mapping[str, Any]) -> None:
        """Print them."""
        for name in known["agents"]:
            echo(name)


@attrs.frozen(kw_only=True)
class DisarmAgent(_OfRun):
    """End an agent's authority: the arm holds until you grant it again, or enter its mode."""

    def __call__(self) -> None:
        ask(self.path(), "/agent/disarm")


@attrs.frozen(kw_only=True)
class ShowAgents(_OfRun):
    """Show the connected agents, and what they may do."""

    def __call__(self) -> Any:
        return ask(self.path(), "/agent/status")

    def show(self, status: Mapping[str, Any]) -> None:
        """Print it."""
        echo(f"connected: {', '.join(status['agents']) or 'none'}")
        if status["armed"]:
            grant = status["grant"]
            services = ", ".join(grant["services"])
            echo(f"{status['armed']}: {status['left_s']:.0f} s left at {grant['speed']:.0%}, {services}")
        elif status["ended"]:
            echo(f"the last authority ended: {status['ended']}")


def _user() -> str:
    """Who grants it, for the log. In containers, the number of a user often has no name."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def _bounds(text: str) -> tuple[str, list[list[float]]]:
    """A region as `PATH=LOW:HIGH,…`."""
    path, _, rest = text.partition("=")
    try:
        bounds = [[float(each) for each in part.split(":")] for part in rest.split(",")]
    except ValueError:
        bounds = []
    if not path or not bounds or any(len(each) != 2 for each in bounds):
        raise RequestError(f"--region {text!r}: write e.g. tool.position=0.1:0.4,-0.2:0.2,0.0:0.4")
    return path, bounds
