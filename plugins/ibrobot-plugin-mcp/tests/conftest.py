"""A run without a robot, whose services note what moves it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from types import NoneType, SimpleNamespace
from typing import Any, cast

import attrs
import pytest
from ibrobot_mcp.server import AgentServer
from ibrobot_terminal.authority import authority_of
from ibrobot_testing import make_session, stand_in
from mcp import Client

from ibrobot_core.api import option
from ibrobot_core.app import NoRequest, Service, Session


@attrs.frozen
class Motion:
    """A motion."""

    to: float = option(ge=-1, le=1, unit="rad", help="where to")
    how: str = option("gently", choices=("gently", "fast"), help="how it moves")
    names: tuple[str, ...] = option((), help="what may be touched")


@attrs.frozen
class Numbered:
    """A number."""

    number: int = option(ge=0, help="of the motion")


RESULT: Service[Numbered, Any] = Service("/test/result", Numbered, object, "How it ended.", "number", reads=True)
CANCEL = Service("/test/cancel", NoRequest, NoneType, "Stop moving.", urgent=True)
MOVE = Service("/test/move", Motion, int, "Move.", "to", result=RESULT, cancel=CANCEL)
FORGET = Service("/test/forget", NoRequest, NoneType, "Forget the obstacles.", persons=True)
STATE = Service("/test/state", NoRequest, float, "Where it is.", reads=True)
STOP = Service("/estop", NoRequest, NoneType, "Stop.", urgent=True)


class Rig:
    """A run.

    Attributes:
        moves: what moved the robot, and what stopped it.
    """

    def __init__(self) -> None:
        self.session: Session = make_session()
        self.moves: list[Any] = []
        control = {
            "report": {"loop": {}, "counters": {}},
            "running": True,
            "call": self.control,
            "write_plan": self.plan,
        }
        self.session.control = cast("Any", SimpleNamespace(**control, stops=0))
        self.authority = authority_of(self.session)
        bus = self.session.bus
        bus.serve(stand_in("/set_mode"), lambda request: None)
        bus.serve(MOVE, self.move)
        bus.serve(RESULT, lambda request: f"motion {request.number} has ended")
        bus.serve(CANCEL, lambda request: self.moves.append("cancel"))
        bus.serve(FORGET, lambda request: self.moves.append("forget"))
        bus.serve(STATE, lambda request: 0.5)
        bus.serve(STOP, lambda request: self.moves.append("stop"))
        self.authority.open()
        self.server = AgentServer(self.session)

    def control(self, command: Any, **more: Any) -> dict[str, Any]:
        return {}

    def plan(self, plan: Any) -> None:
        self.moves.append("brake")

    def move(self, motion: Motion) -> int:
        self.moves.append(motion.to)
        return len(self.moves)

    def grant(self, **more: Any) -> None:
        self.session.bus.call("/agent/arm", {"seconds": 60.0, "services": ["/test/move"], **more})

    def talk(self, act: Callable[[Client], Awaitable[Any]], mode: str = "auto") -> Any:
        """Connect an agent, and have it act."""

        async def connected() -> Any:
            async with Client(self.server.protocol, mode=mode) as client:
                return await act(client)

        return asyncio.run(connected())

    def close(self) -> None:
        asyncio.run(self.server.close())
        self.authority.close()


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()
