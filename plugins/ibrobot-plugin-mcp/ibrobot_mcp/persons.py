"""A socket of this machine for `ibrobot agent …`, which its user calls to grant authority."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from ibrobot_ros2.services import plain
from ibrobot_terminal.agent_calls import AgentCalls, planned_path
from ibrobot_terminal.authority import Authority

from ibrobot_core.api import IbrobotError, did_you_mean
from ibrobot_core.app import RequestError, RunView, error_text
from ibrobot_mcp.tokens import own_folder

SERVICES = ("/agent/arm", "/agent/disarm", "/agent/status")
ASKED = "asked"
"""Instead of a service: what an agent asked for last."""
_LARGEST = 64 * 1024
_TIMEOUT_S = 10.0
_AT_ONCE, _WAITING = 8, 16
"""Most callers that are answered at the same time, and most others that wait for them."""
MOVING = Authority.usual
"""What is granted by default, of what a run serves."""


_RUNTIMES = Path("/run/user")
"""Where systemd makes the folder of a user's session, to which it sets XDG_RUNTIME_DIR."""
_WITHOUT = Path("/tmp")
"""For the sockets where there is no such folder. Not $TMPDIR, which programs of agents do not pass on, either."""


def sockets_folder() -> Path:
    """The folder of the sockets, which only this user may enter.

    It is the same for `ibrobot mcp` and for the person's terminal, although most agents' programs start the former with
    few variables of the environment, without XDG_RUNTIME_DIR.

    Raises:
        IbrobotError: if another user owns it, or it is a link, which another user may have made.
    """
    user = os.getuid()
    usual = _RUNTIMES / str(user)
    runtime = os.environ.get("XDG_RUNTIME_DIR") or (str(usual) if usual.is_dir() else "")
    return own_folder(Path(runtime) / "ibrobot" if runtime else _WITHOUT / f"ibrobot-{user}", "XDG_RUNTIME_DIR")


class Persons:
    """Answers `ibrobot agent …` of the user of this machine, in a thread, until `close`.

    Args:
        session: the run.
    """

    def __init__(self, session: RunView) -> None:
        self._session = session
        self.path = sockets_folder() / f"{session.config.robot.name}.{os.getpid()}"
        self.path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.bind(str(self.path))
        self._socket.listen(_WAITING)
        self._calls = AgentCalls(session)
        self._open: set[socket.socket] = set()
        self._answering = ThreadPoolExecutor(_AT_ONCE, "person")
        self._thread = threading.Thread(target=self._serve, name="persons", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop. Safe to call twice."""
        self._calls.close()
        for each in (self._socket, *self._open):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join()
        self._answering.shutdown()
        self.path.unlink(missing_ok=True)

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:  # closed
                return
            self._open.add(connection)
            self._answering.submit(self._answer_at, connection)

    def _answer_at(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError, ValueError, RecursionError):
            connection.settimeout(_TIMEOUT_S)
            connection.sendall(json.dumps(self._answer(json.loads(_received(connection)))).encode())
        self._open.discard(connection)

    def _answer(self, request: Any) -> Any:
        if isinstance(request, dict) and request.get("service") == ASKED:
            return {"answer": self._asked()}
        if not isinstance(request, dict) or request.get("service") not in SERVICES:
            return {"error": f"this socket serves {', '.join(SERVICES)}"}
        try:
            if request["service"] == "/agent/arm":
                check_services(self._session, request.get("request"))
            return {"answer": plain(self._session.bus.call(request["service"], request.get("request")))}
        except IbrobotError as error:
            return {"error": str(error)}
        except Exception as error:
            self._session.log.exception("%s failed", request["service"])
            return {"error": f"{request['service']} failed: {error_text(error)}; please report it"}

    def _asked(self) -> Any:
        """What an agent asked for last, with its path at full speed; None if it asked for nothing."""
        if (newest := self._calls.newest) is None:
            return None
        path = planned_path(self._session, newest)
        return {
            "agent": newest.agent, "service": newest.service, "request": newest.request, "refused": newest.refused,
            "seconds": path.seconds, "path": path.text,
        }  # fmt: skip


def check_services(session: RunView, grant: Any) -> None:
    """Check that an agent may be granted the services that a person names.

    Raises:
        RequestError: for one that nobody serves now, that needs no grant, or that is for persons.
    """
    names = grant.get("services") if isinstance(grant, Mapping) else None
    known = session.bus.services()
    granted = sorted(name for name, each in known.items() if not (each.reads or each.urgent or each.persons))
    for name in names if isinstance(names, list | tuple) else ():
        service = known.get(name) if isinstance(name, str) else None
        if service is None and name not in MOVING:
            hint = did_you_mean(str(name), granted, "these can be granted")
            raise RequestError(f"--allow {name}: nobody serves it in mode {session.mode}{hint}")
        if service is not None and service.persons:
            raise RequestError(f"--allow {name}: it is for persons only, and cannot be granted")
        if service is not None and (service.reads or service.urgent):
            raise RequestError(f"--allow {name}: it moves nothing, so that it needs no grant")


def running(timeout_s: float = _TIMEOUT_S) -> Iterator[Path]:
    """The sockets of the robots that run here; those of killed runs are removed.

    Args:
        timeout_s: longest wait for a run that is busy [s].
    """
    for path in sorted(each for each in sockets_folder().iterdir() if each.is_socket()):
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(timeout_s)
            try:
                probe.connect(str(path))
            except ConnectionRefusedError:  # of a run that was killed
                path.unlink(missing_ok=True)
                continue
            except OSError:  # it is busy, or has just ended
                pass
        yield path


def ask(path: Path, service: str, request: Any = None) -> Any:
    """Call a service of a robot that runs here.

    Raises:
        IbrobotError: with the robot's reason, or if it does not answer.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(_TIMEOUT_S)
        try:
            connection.connect(str(path))
            connection.sendall(json.dumps({"service": service, "request": request}).encode())
            connection.shutdown(socket.SHUT_WR)
            answer = json.loads(_received(connection))
        except (OSError, ValueError) as error:
            raise IbrobotError(f"{path.name} does not answer: {error}") from None
    if "error" in answer:
        raise IbrobotError(answer["error"])
    return answer["answer"]


def _received(connection: socket.socket) -> bytes:
    data = b""
    while len(data) <= _LARGEST and (part := connection.recv(4096)):
        data += part
    return data
