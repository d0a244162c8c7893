"""Guard of every request (host, origin, session), and headers of every answer.

A page is opened by a link with a token, or by a password. Both give a session: a cookie that scripts cannot read and
that no other site sends along. Its name contains the port, since cookies do not distinguish ports.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import re
import secrets
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Sequence
from urllib.parse import parse_qs

from aiohttp import web

from ibrobot_http.files import STYLE
from ibrobot_http.listener import Listener, bracketed

REQUEST_S = 5.0
"""Time in which a client must send a request [s]."""
_SESSIONS = 100
"""Maximum number of sessions; the least recently used one ends first."""
_TRY_S = 1.0
"""Minimum time between two password attempts [s]."""
_SIGN_IN_BYTES = 4096
"""Largest form with a password [bytes]."""
_ROLE = web.RequestKey("role", str)
_CSP = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; media-src 'self'; "
    "connect-src 'self' {sockets}; base-uri 'none'; form-action {forms}; frame-ancestors 'none'"
)
_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_PAGE = f"""<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>ibrobot: {{title}}</title><link rel="stylesheet" href="{STYLE}">
<main class="signin">{{content}}</main></html>"""
_LOGIN = """<h1>ibrobot</h1><form method="post" action="/login">
<label for="password">Password</label><input id="password" name="password" type="password"
autocomplete="current-password" autofocus required><button class="primary">Sign in</button>
<p role="alert">{message}</p></form>"""
_CLOSED = """<h1>This page needs its link</h1>
<p>Open the whole address that the terminal of the robot shows, with its token.</p>"""
_NO_SESSION = "no session: open the link that the terminal shows"
_log = logging.getLogger("ibrobot.http")


class Guard:
    """Admits requests, and adds the headers of all answers.

    A request must name this server as its host, which defeats DNS rebinding. It must not come from another site. A
    WebSocket must come from this server's own page.

    Args:
        listener: where the server listens.
        roles: what a session may do, e.g. `drive` and `watch`; each has a link of its own. Without roles, no session is
            needed.
        password: opens a session of the first role, in place of its link; None to use the link.
        other_sites_link: whether links from any other site, such as a scanned code, may open the page. Otherwise only
            those from servers of this machine may.
        any_port: whether clients may name another port, e.g. that of a tunnel.
        strict_transport: whether browsers refuse this machine without TLS, or with an untrusted certificate, for a
            year (HSTS).
        permissions: the policy for a browser's devices.
    """

    def __init__(
        self,
        listener: Listener,
        *,
        roles: Sequence[str] = (),
        password: str | None = None,
        other_sites_link: bool = False,
        any_port: bool = False,
        strict_transport: bool = False,
        permissions: str = "camera=(), microphone=(), geolocation=(), usb=(), serial=()",
    ) -> None:
        self.listener = listener
        self._secure = listener.tls is not None
        self._password = password
        self._other_sites_link = other_sites_link
        self._any_port = any_port
        self._tokens = {role: secrets.token_urlsafe(24) for role in roles}
        self._sessions: OrderedDict[str, str] = OrderedDict()
        """Key of a session -> its role."""
        self._next_try_s = 0.0
        self._refused: set[str] = set()
        self._cookie = f"{'__Host-' if self._secure else ''}ibrobot_{listener.port}"
        names = {bracketed(name).lower() for name in listener.names}
        default = listener.port == (443 if self._secure else 80)
        self._hosts = {f"{name}:{listener.port}" for name in names} | (names if default or any_port else set())
        self._headers = {**_HEADERS, "Permissions-Policy": permissions}
        if self._secure and strict_transport:
            self._headers["Strict-Transport-Security"] = "max-age=31536000"

    def path(self, role: str) -> str:
        """The path of the link that opens a session; a password takes the place of the first role's token."""
        return f"/?token={self._tokens[role]}" if self._may_redeem(role) else "/"

    def link(self, role: str) -> str:
        """The address that opens a session."""
        return self.listener.url + self.path(role)

    def role(self, request: web.Request) -> str:
        """The role of an admitted request."""
        return request[_ROLE]

    @web.middleware
    async def middleware(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Answer a request that is not admitted; pass others on, once their body has arrived."""
        if (refusal := self._foreign(request)) is not None:
            return self._refuse(403, refusal)
        if self._tokens:
            if request.method == "GET" and request.path == "/" and "token" in request.query:
                return self._redeem(request.query["token"])
            if request.method == "POST" and request.path == "/login" and self._password is not None:
                return await self._sign_in(request, self._password)
            key = request.cookies.get(self._cookie, "")
            if key not in self._sessions:
                return await handler(request) if request.path == STYLE else self._unknown(request)
            self._sessions.move_to_end(key)
            request[_ROLE] = self._sessions[key]
        await _read(request)
        return await handler(request)

    async def add_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        """Add the headers of every answer; a signal handler."""
        for name, value in self._headers.items():
            response.headers.setdefault(name, value)
        host = request.headers.get("Host", "").lower()  # `request.host` would ask for this machine's name
        sockets = f"{'wss' if self._secure else 'ws'}://{host}" if host in self._hosts else ""
        forms = "'none'" if self._password is None else "'self'"
        response.headers["Content-Security-Policy"] = _CSP.format(sockets=sockets, forms=forms)
        response.headers["Server"] = "ibrobot"  # instead of aiohttp's and Python's versions

    def _foreign(self, request: web.Request) -> str | None:
        """Why a request is not of this server's own pages; None if it may be."""
        if not request.raw_path.startswith("/"):
            return "a request must name a path: this server is no proxy"
        hosts = request.headers.getall("Host", [])
        host = hosts[0].lower() if len(hosts) == 1 else ""
        if (re.sub(r":[0-9]+$", "", host) if self._any_port else host) not in self._hosts:
            return "this host name is not served: use the address that the terminal shows"
        origins = request.headers.getall("Origin", [])
        if any(origin.lower() != f"{self.listener.scheme}://{host}" for origin in origins):
            return "requests of other sites are refused"
        if not origins and "websocket" in request.headers.get("Upgrade", "").lower():
            return "a WebSocket needs the origin of its page"
        linked = ("same-site", "cross-site") if self._other_sites_link else ("same-site",)
        for site in request.headers.getall("Sec-Fetch-Site", []):
            if site not in ("same-origin", "none") and not (site in linked and _opens_page(request)):
                return "requests of other sites are refused"
        return None

    def _may_redeem(self, role: str) -> bool:
        return self._password is None or role != next(iter(self._tokens))

    def _redeem(self, given: str) -> web.StreamResponse:
        for role, token in self._tokens.items():
            if self._may_redeem(role) and hmac.compare_digest(given.encode(errors="replace"), token.encode()):
                return self._open(role)
        return self._closed()

    async def _sign_in(self, request: web.Request, password: str) -> web.StreamResponse:
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            return _page("sign in", _LOGIN.format(message="Too many attempts. Try again in a second."), 429)
        self._next_try_s = now_s + _TRY_S
        if request.content_length is None or request.content_length > _SIGN_IN_BYTES:
            raise web.HTTPRequestEntityTooLarge(_SIGN_IN_BYTES, request.content_length or 0)
        await _read(request)
        is_form = request.content_type == "application/x-www-form-urlencoded"
        form = parse_qs((await request.read()).decode(errors="replace") if is_form else "")
        if hmac.compare_digest(form.get("password", [""])[0].encode(), password.encode()):
            self._next_try_s = 0.0
            return self._open(next(iter(self._tokens)))
        return _page("sign in", _LOGIN.format(message="Wrong password."), 401)

    def _open(self, role: str) -> web.StreamResponse:
        """Open a session, and lead to an address without the token."""
        key = secrets.token_urlsafe(24)
        self._sessions[key] = role
        while len(self._sessions) > _SESSIONS:
            self._sessions.popitem(last=False)
        response = web.Response(status=303, headers={"Location": "/"})
        # A session that another site's link opens is not sent by Strict when that link leads on to the page.
        same_site = "Lax" if self._other_sites_link else "Strict"
        response.set_cookie(self._cookie, key, httponly=True, samesite=same_site, secure=self._secure, path="/")
        return response

    def _unknown(self, request: web.Request) -> web.StreamResponse:
        if request.method != "GET" or request.path != "/":
            return self._refuse(401, _NO_SESSION)
        return self._closed() if self._password is None else _page("sign in", _LOGIN.format(message=""), 401)

    def _closed(self) -> web.StreamResponse:
        self._note("a request without the link's token")
        return _page("no session", _CLOSED, 401)

    def _refuse(self, status: int, reason: str) -> web.StreamResponse:
        self._note(f"a request: {reason}")
        return web.Response(status=status, text=f"{reason}\n")

    def _note(self, reason: str) -> None:
        """Log each reason once."""
        if reason not in self._refused:
            self._refused.add(reason)
            _log.warning("port %d: refused %s", self.listener.port, reason)


async def _read(request: web.Request) -> None:
    """Read the body of a request, so that handlers need not wait for it.

    Raises:
        web.HTTPException: if it does not arrive in time, or is no body.
    """
    if not request.can_read_body:
        return
    try:
        async with asyncio.timeout(REQUEST_S):
            await request.read()
    except TimeoutError:
        raise web.HTTPRequestTimeout from None
    except (web.RequestPayloadError, ConnectionError):
        raise web.HTTPBadRequest from None


def _page(title: str, content: str, status: int) -> web.StreamResponse:
    return web.Response(status=status, text=_PAGE.format(title=title, content=content), content_type="text/html")


def _opens_page(request: web.Request) -> bool:
    """Whether a browser follows a link to the page itself, in a tab: `ibrobot ui` links to the pages of its runs.

    To browsers, servers of one machine are one site, whatever their ports.
    """
    kind = (request.headers.get("Sec-Fetch-Mode"), request.headers.get("Sec-Fetch-Dest"))
    return request.method == "GET" and request.path == "/" and kind == ("navigate", "document")
