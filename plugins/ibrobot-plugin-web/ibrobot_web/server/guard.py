"""The guard in front of every request: host, origin, session; and the headers of every answer.

A page may be opened by the link with the token, or by the password. Both give a session: a cookie that scripts cannot
read and that no other site sends along. Its name contains the port, since cookies do not distinguish ports.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from typing import Literal

import attrs
from aiohttp import web

Role = Literal["drive", "watch"]
"""What a session may do: drive the robot, or only watch it."""
_SESSIONS = 100
"""Number of sessions kept; the one unused for the longest time ends first."""
_TRY_S = 1.0
"""Time between two attempts at the password [s]."""
_LOGIN_BYTES = 4096
_STYLE = "/static/style.css"
"""The one file that the sign-in form needs."""
_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; font-src 'self'; "
    "worker-src 'self'; connect-src 'self' {sockets}; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=(), usb=(), serial=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_LOGIN = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>ibrobot: sign in</title><link rel="stylesheet" href="/static/style.css">
<main class="signin"><h1>ibrobot</h1><form method="post" action="/login">
<label for="password">Password</label><input id="password" name="password" type="password"
autocomplete="current-password" autofocus required><button class="primary">Sign in</button>
<p role="alert">{message}</p></form></main></html>"""
_CLOSED = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>ibrobot</title><link rel="stylesheet" href="/static/style.css">
<main class="signin"><h1>This page needs its link</h1>
<p>Open the whole address that the terminal shows, with its token.</p></main></html>"""


@attrs.define(eq=False)
class Session:
    """The session of a browser."""

    key: str
    role: Role


class Guard:
    """Admits requests.

    Args:
        names: host names, without port, under which browsers may reach this server.
        secure: whether the server uses TLS.
        password: in place of the token for driving; None to use the token.
    """

    def __init__(self, names: Sequence[str], *, secure: bool, password: str | None = None) -> None:
        self._names = tuple(names)
        self._secure = secure
        self._password = password
        self._tokens: dict[Role, str] = {"drive": secrets.token_urlsafe(24), "watch": secrets.token_urlsafe(24)}
        self._sessions: OrderedDict[str, Session] = OrderedDict()
        self._next_try_s = 0.0
        self._cookie = "ibrobot"
        self._hosts: frozenset[str] = frozenset()

    def listen_on(self, port: int) -> None:
        """Set the port of the server, once it is known."""
        self._cookie = f"ibrobot_{port}"
        default = 443 if self._secure else 80
        hosts = {f"{name}:{port}" for name in self._names} | (set(self._names) if port == default else set())
        self._hosts = frozenset(host.lower() for host in hosts)

    def path(self, role: Role) -> str:
        """The path of the link that opens a session; a password takes the place of the driver's token."""
        return "/" if role == "drive" and self._password is not None else f"/?token={self._tokens[role]}"

    @web.middleware
    async def middleware(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Answer a request that is not admitted; pass others on."""
        if (refusal := self._foreign(request)) is not None:
            return web.Response(status=403, text=f"{refusal}\n")
        if request.path == "/" and "token" in request.query:
            return self._redeem(request.query["token"])
        if request.path == "/login" and request.method == "POST" and self._password is not None:
            return await self._sign_in(request)
        session = self._sessions.get(request.cookies.get(self._cookie, ""))
        if session is None:
            return await handler(request) if request.path == _STYLE else self._unknown(request)
        self._sessions.move_to_end(session.key)
        return await handler(request)

    def session(self, request: web.Request) -> Session:
        """The session of an admitted request."""
        return self._sessions[request.cookies[self._cookie]]

    async def add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        """Add the headers of every answer; a signal handler."""
        for name, value in _HEADERS.items():
            response.headers.setdefault(name, value)
        sockets = f"{'wss' if self._secure else 'ws'}://{request.host}" if request.host in self._hosts else ""
        response.headers["Content-Security-Policy"] = _CSP.format(sockets=sockets)
        if self._secure:
            response.headers["Strict-Transport-Security"] = "max-age=31536000"

    def _foreign(self, request: web.Request) -> str | None:
        """Why a request is not of this server's own pages; None if it may be."""
        hosts = request.headers.getall("Host", [])
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return "this host name is not served: use the address that the terminal shows, or set viewer.names"
        scheme = "https" if self._secure else "http"
        for origin in request.headers.getall("Origin", []):
            if origin.lower() != f"{scheme}://{hosts[0].lower()}":
                return "requests of other sites are refused"
        site = request.headers.get("Sec-Fetch-Site", "none")
        if site not in ("same-origin", "none") and not (site == "same-site" and _opens_page(request)):
            return "requests of other sites are refused"
        return None

    def _redeem(self, token: str) -> web.StreamResponse:
        for role, known in self._tokens.items():
            usable = role == "watch" or self._password is None
            if usable and hmac.compare_digest(token.encode(errors="replace"), known.encode()):
                return self._open(role)
        return web.Response(status=401, text=_CLOSED, content_type="text/html")

    async def _sign_in(self, request: web.Request) -> web.StreamResponse:
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            return self._form("Too many attempts. Try again in a second.", 429)
        self._next_try_s = now_s + _TRY_S
        if (request.content_length or 0) > _LOGIN_BYTES:
            return self._form("The password is too long.", 413)
        given = (await request.post()).get("password", "")
        assert self._password is not None
        if isinstance(given, str) and hmac.compare_digest(given.encode(), self._password.encode()):
            self._next_try_s = 0.0
            return self._open("drive")
        return self._form("Wrong password.", 401)

    def _open(self, role: Role) -> web.StreamResponse:
        """Open a session, and lead to an address without the token."""
        session = Session(secrets.token_urlsafe(24), role)
        self._sessions[session.key] = session
        while len(self._sessions) > _SESSIONS:
            self._sessions.popitem(last=False)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(self._cookie, session.key, httponly=True, samesite="Strict", secure=self._secure, path="/")
        return response

    def _unknown(self, request: web.Request) -> web.StreamResponse:
        if request.method == "GET" and request.path == "/":
            if self._password is not None:
                return self._form("", 401)
            return web.Response(status=401, text=_CLOSED, content_type="text/html")
        return web.Response(status=401, text="no session: open the link that the terminal shows\n")

    @staticmethod
    def _form(message: str, status: int) -> web.StreamResponse:
        return web.Response(status=status, text=_LOGIN.format(message=message), content_type="text/html")


def _opens_page(request: web.Request) -> bool:
    """Whether a browser follows a link to the page itself, in a tab: `ibrobot ui` links to the pages of its runs.

    To browsers, servers of one machine are one site, whatever their ports.
    """
    kind = (request.headers.get("Sec-Fetch-Mode"), request.headers.get("Sec-Fetch-Dest"))
    return request.method == "GET" and request.path == "/" and kind == ("navigate", "document")
