"""Who may reach the page: requests for this server, from its own page, with the token of this launch."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Sequence
from http import HTTPStatus

import attrs

_TOKEN_BYTES = 18
_MOST_SESSIONS = 32
"""Browsers that may be logged in; the oldest is logged out."""


class Refused(Exception):
    """A request that is refused, with the status and the reason of the answer."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


@attrs.frozen
class Request:
    """What a guard looks at in a request; a header is None if the request lacks it."""

    host: str | None
    origin: str | None
    site: str | None
    """`Sec-Fetch-Site`: where the request comes from, by the browser."""
    session: str | None
    """The session in the cookie."""


class Guard:
    """Checks every request.

    - `Host` must be one of the names of the server, with its port. Others are names of pages that now resolve to this
      machine.
    - Requests that another site makes are refused, but for opening the page itself.
    - The socket's `Origin` must be this page.
    - All but the log-in needs a session, which a browser has from the token.

    Args:
        names: names and addresses of the server.

    Attributes:
        token: logs a browser in. New at each launch.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._hosts: frozenset[str] = frozenset()
        self._sessions: list[str] = []
        self.token = secrets.token_urlsafe(_TOKEN_BYTES)

    def serve_at(self, port: int) -> None:
        """Set the port of the server."""
        named = [f"[{name}]" if ":" in name else name for name in self._names]
        bare = [] if port != 443 else named
        self._hosts = frozenset((*(f"{name}:{port}" for name in named), *bare))

    def check_site(self, request: Request, *, opens_page: bool) -> None:
        """Check that a request is for this server and, unless it opens the page, comes from the page.

        Raises:
            Refused: if not.
        """
        if request.host is None or request.host.lower() not in self._hosts:
            raise Refused(HTTPStatus.MISDIRECTED_REQUEST, "this server does not have the name in the address")
        if request.site not in (None, "same-origin", "none") and not opens_page:
            raise Refused(HTTPStatus.FORBIDDEN, "the request comes from another site")

    def check_origin(self, request: Request) -> None:
        """Check that a socket is opened by the page.

        Raises:
            Refused: if not.
        """
        if request.origin is None or request.origin.lower() != f"https://{(request.host or '').lower()}":
            raise Refused(HTTPStatus.FORBIDDEN, "the page of another site wants to connect")

    def check_session(self, request: Request) -> None:
        """Check that a browser has logged in.

        Raises:
            Refused: if not.
        """
        if request.session is None or not any(
            hmac.compare_digest(request.session.encode(), session.encode()) for session in self._sessions
        ):
            raise Refused(
                HTTPStatus.UNAUTHORIZED, "scan the QR code in the terminal of the robot, or open the address below it"
            )

    def log_in(self, token: str) -> str:
        """A new session for a token.

        Raises:
            Refused: if the token is wrong.
        """
        if not hmac.compare_digest(token.encode(errors="replace"), self.token.encode()):
            raise Refused(HTTPStatus.FORBIDDEN, "wrong token: scan the QR code of the present launch")
        session = secrets.token_urlsafe(_TOKEN_BYTES)
        self._sessions = [*self._sessions[1 - _MOST_SESSIONS :], session]
        return session
