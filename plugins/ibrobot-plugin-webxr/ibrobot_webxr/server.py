"""The server of the page, in a thread of its own: HTTPS, and a WebSocket for each open page."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import ssl
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from http import HTTPStatus
from importlib.resources import files
from typing import Any

import attrs
from aiohttp import WSMsgType, web

from ibrobot_core.api import Clock, RobotStatus, TeleopError
from ibrobot_core.app import ESTOP, Bus, error_text
from ibrobot_webxr.certificate import CERTIFICATE, own_folder, server_names, tls_context
from ibrobot_webxr.exchange import Delays, Exchange
from ibrobot_webxr.guard import Guard, Refused, Request
from ibrobot_webxr.images import CameraImages
from ibrobot_webxr.messages import LONGEST, Claim, Hands, Press, Shown, Stop, decode
from ibrobot_webxr.options import HANDS, WebxrOptions

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}
_START_S = 10.0
_STATE_S = 0.1
"""Period of the states sent to pages [s]."""
_SILENT_S = 1.0
"""A page that has control and sends nothing for that long loses it [s]."""
_CLOSING_S = 0.05
"""Time at the end in which connections close [s]."""
_HANDSHAKE_S = 5.0
_MOST_PAGES = 8
_MOST_REFUSED = 100
"""Wrong messages after which a page is disconnected."""
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Permissions-Policy": "xr-spatial-tracking=(self), accelerometer=(self), gyroscope=(self), magnetometer=(self)",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}


@attrs.define(eq=False)
class _Page:
    """An open page."""

    socket: web.WebSocketResponse
    delays: Delays = attrs.field(factory=Delays)
    heard_s: float = attrs.field(factory=time.monotonic)
    """When its last message came [s]."""
    shown: dict[str, int] = attrs.field(factory=dict)
    """Camera -> number of the newest image sent."""
    waits: set[str] = attrs.field(factory=set)
    """Cameras with an image that the page has not shown yet."""
    refused: int = 0
    error: str = ""
    """The last message that was refused, and why."""


class PageServer:
    """Serves the page until `close`. The first open page has control; others watch.

    Args:
        options: the address, the certificate, the cameras.
        clock: the clock of the run.
        bus: the bus of the run, for images, status and the emergency stop; None without one.
        log: where the server reports.
        folder: where the own certificate is kept; None: its usual folder.

    Attributes:
        exchange: the poses of the page.
        port: the port.

    Raises:
        TeleopError: if the certificate cannot be used or the address is not available.
    """

    def __init__(
        self, options: WebxrOptions, clock: Clock, bus: Bus | None, log: logging.Logger, folder: Any = None
    ) -> None:
        names = server_names(options)
        context = tls_context(options, folder)
        self._options = options
        self._bus = bus
        self._log = log
        self._name = names[0]
        self._guard = Guard(names)
        self._images = CameraImages(bus, options.cameras, log) if bus is not None else None
        self._status = bus.subscribe("/robot_status", 1) if bus is not None else None
        self._robot: RobotStatus | None = None
        self._pages: list[_Page] = []
        self._control: _Page | None = None
        self._refused: Counter[str] = Counter()
        self.exchange = Exchange(clock)
        self.port = options.port
        self._files = {
            path.name: (path.read_bytes(), _KINDS[path.name.rpartition(".")[2]])
            for path in files("ibrobot_webxr").joinpath("page").iterdir()
            if path.name.rpartition(".")[2] in _KINDS
        }
        self._files["certificate.pem"] = _trusted(options, folder)
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._started = threading.Event()
        self._failure: OSError | None = None
        self._thread = threading.Thread(target=self._run, args=(context,), name="webxr page", daemon=True)
        self._thread.start()
        self._started.wait(_START_S)
        if self._failure is not None:
            self.close()
            raise TeleopError(
                f"port {options.port} of {options.host} is not available: {self._failure.strerror}; choose another"
            )

    @property
    def address(self) -> str:
        """The address that logs a browser in, with the token."""
        name = f"[{self._name}]" if ":" in self._name else self._name
        return f"https://{name}:{self.port}/?token={self._guard.token}"

    def close(self) -> None:
        """Stop the server. Safe to call twice."""
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._ending.set)
            self._thread.join()
            self._loop.close()
        if self._images is not None:
            self._images.close()
        if self._status is not None:
            self._status.close()

    def _run(self, context: ssl.SSLContext) -> None:
        self._loop.set_exception_handler(lambda loop, found: self._log.debug("webxr: %s", found.get("message")))
        try:
            self._loop.run_until_complete(self._serve(context))
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._started.set()

    async def _serve(self, context: ssl.SSLContext) -> None:
        app = web.Application(middlewares=[self._guarded], client_max_size=0)
        app.router.add_get("/", self._index, allow_head=False)
        app.router.add_get("/socket", self._socket)
        app.router.add_get("/{name}", self._file, allow_head=False)
        # The access log would have the token.
        runner = web.AppRunner(app, access_log=None, logger=_quiet(self._log), shutdown_timeout=0.1)
        await runner.setup()
        assert runner.server is not None
        try:
            # Clients that do not finish their handshake are disconnected, which web.TCPSite leaves to a minute.
            listener = await self._loop.create_server(
                runner.server, self._options.host, self._options.port, ssl=context, ssl_handshake_timeout=_HANDSHAKE_S
            )
        except OSError as error:
            self._failure = error
            await runner.cleanup()
            return
        try:
            self.port = listener.sockets[0].getsockname()[1]
            self._guard.serve_at(self.port)
            self._started.set()
            await self._tell_until_end()
        finally:
            listener.close()
            for page in tuple(self._pages):
                with contextlib.suppress(OSError, RuntimeError, asyncio.TimeoutError):
                    await asyncio.wait_for(page.socket.close(), 0.5)
            for connection in runner.server.connections:
                if connection.transport is not None:
                    connection.transport.abort()  # browsers keep connections open
            await runner.cleanup()
            await asyncio.sleep(_CLOSING_S)

    @web.middleware
    async def _guarded(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        """Check every request, and add the headers to every answer."""
        try:
            seen = self._seen(request)
            opens = request.path == "/"
            self._guard.check_site(seen, opens_page=opens)
            if request.path == "/socket":
                self._guard.check_origin(seen)
            if not (opens and "token" in request.query):
                self._guard.check_session(seen)
            response = await handler(request)
        except Refused as refused:
            self._count(f"{refused.status} {refused}")
            response = web.Response(status=refused.status, text=f"{refused}\n")
        except web.HTTPException as error:
            response = web.Response(status=error.status, text=f"{error.reason}\n")
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    def _seen(self, request: web.Request) -> Request:
        headers = request.headers
        hosts = headers.getall("Host", [])
        return Request(
            hosts[0] if len(hosts) == 1 else None,
            headers.get("Origin"),
            headers.get("Sec-Fetch-Site"),
            request.cookies.get(self._cookie),
        )

    @property
    def _cookie(self) -> str:
        # Cookies ignore ports: two robots on one machine would share one.
        return f"__Host-ibrobot-webxr-{self.port}"

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if (token := request.query.get("token")) is None:
            return self._answer("index.html")
        session = self._guard.log_in(token)
        response = web.Response(status=HTTPStatus.SEE_OTHER, headers={"Location": "/"})
        # Lax: scanning a QR code counts as a link from another site on some phones.
        response.set_cookie(self._cookie, session, secure=True, httponly=True, samesite="Lax", path="/")
        return response

    async def _file(self, request: web.Request) -> web.StreamResponse:
        return self._answer(request.match_info["name"])

    def _answer(self, name: str) -> web.StreamResponse:
        if name not in self._files:
            return web.Response(status=HTTPStatus.NOT_FOUND, text="no such page\n")
        body, kind = self._files[name]
        return web.Response(body=body, headers={"Content-Type": kind})

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._pages) >= _MOST_PAGES:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, f"{_MOST_PAGES} pages are open: close one")
        socket = web.WebSocketResponse(max_msg_size=LONGEST, heartbeat=2.0, compress=False, timeout=0.5)
        await socket.prepare(request)
        page = _Page(socket)
        self._pages.append(page)
        if self._control is None:
            self._control = page
        sending = asyncio.ensure_future(self._send_images(page))
        try:
            async for message in socket:
                if message.type is not WSMsgType.TEXT:
                    self._refuse(page, "not text")
                else:
                    await self._take(page, message.data)
                if page.refused >= _MOST_REFUSED:
                    break
        finally:
            sending.cancel()
            self._pages.remove(page)
            self._release(page)
            await socket.close()
        return socket

    async def _take(self, page: _Page, text: str) -> None:
        """Follow a message of a page."""
        page.heard_s = time.monotonic()
        try:
            message = decode(text)
        except ValueError as error:
            self._refuse(page, str(error))
            return
        match message:
            case Stop():
                await self._stop()
            case Claim():
                if self._control is None:
                    self._control = page
            case Shown(camera):
                self._next_image(page, camera)
            case Hands():
                if page is self._control:
                    self.exchange.put(message, page.delays.late_s(message.time_s, page.heard_s))
                # The page measures the round trip by it, and notices a network that is gone. It may have sent this
                # before it learned that it has lost control.
                await page.socket.send_str(f'{{"type":"echo","n":{message.number}}}')
            case Press(event):
                if page is self._control:
                    self.exchange.press(event)

    async def _stop(self) -> None:
        """Stop the robot, in any mode."""
        self.exchange.stop()
        bus = self._bus
        if bus is not None and bus.serves(ESTOP):
            try:
                await self._loop.run_in_executor(None, lambda: bus.call(ESTOP))
            except Exception as error:  # noqa: BLE001 - contained: the device in `read` stops the robot, too
                self._log.error("webxr: the emergency stop failed: %s", error_text(error))

    def _next_image(self, page: _Page, camera: int) -> None:
        names = self._images.names if self._images is not None else []
        if camera >= len(names):
            self._refuse(page, f"camera: must be below {len(names)}")
            return
        page.waits.discard(names[camera])

    def _refuse(self, page: _Page, reason: str) -> None:
        page.refused += 1
        page.error = reason
        self._count(f"a message of the page: {reason}")

    def _count(self, reason: str) -> None:
        """Count a refusal, and log the first one for each reason."""
        self._refused[reason] += 1
        if self._refused[reason] == 1:
            self._log.warning("webxr: refused %s", reason)

    def _release(self, page: _Page) -> None:
        """Take control from a page, and hold."""
        if page is self._control:
            self._control = None
            self.exchange.put(Hands(0, 0.0, 0.0, {}), 0.0)

    async def _tell_until_end(self) -> None:
        """Send the state to all pages, until the end."""
        while not self._ending.is_set():
            began_s = time.monotonic()
            with contextlib.suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._ending.wait(), _STATE_S)
            now_s = time.monotonic()
            if self._control is not None:
                # While this thread pauses, a page that has just opened does not learn that it may send.
                self._control.heard_s += max(0.0, now_s - began_s - _STATE_S)
                if now_s - self._control.heard_s > _SILENT_S:
                    self._release(self._control)
            if self._images is not None and not self._pages:
                self._images.refresh()  # so that a page that opens has no old image
            if self._status is not None and (received := self._status.get()) is not None:
                assert isinstance(received.message, RobotStatus)
                self._robot = received.message
            await asyncio.gather(*(self._tell(page) for page in self._pages if not page.socket.closed))

    async def _tell(self, page: _Page) -> None:
        with contextlib.suppress(OSError, RuntimeError, asyncio.TimeoutError):
            # A page that does not read gets no more than its socket holds; its heartbeat ends it.
            await asyncio.wait_for(page.socket.send_str(json.dumps(self._state(page))), _STATE_S)

    def _state(self, page: _Page) -> Mapping[str, Any]:
        robot = self._robot
        reports = self.exchange.reports()
        return {
            "type": "state",
            "control": "you" if page is self._control else "free" if self._control is None else "other",
            "hands": {
                hand: {"device": report.device, "engaged": report.engaged, "text": report.text}
                for hand in HANDS
                if (report := reports.get(hand)) is not None
            },
            "cameras": self._images.names if self._images is not None else [],
            "error": page.error,
            "robot": None
            if robot is None
            else {"name": robot.robot, "mode": robot.mode, "estop": robot.estop, "faults": list(robot.faults)},
        }

    async def _send_images(self, page: _Page) -> None:
        """Send a page each camera's newest image when it has shown the one before."""
        images = self._images
        while images is not None and not page.socket.closed:
            await asyncio.sleep(1 / self._options.image_rate)
            images.refresh()
            for index, name in enumerate(images.names):
                number, data = images.newest.get(name, (0, b""))
                if number > page.shown.get(name, 0) and name not in page.waits:
                    page.shown[name] = number
                    page.waits.add(name)
                    with contextlib.suppress(OSError, RuntimeError):
                        await page.socket.send_bytes(bytes([min(index, 255)]) + data)


def _trusted(options: WebxrOptions, folder: Any) -> tuple[bytes, str]:
    """What a phone installs to trust the page, and its type; a text if that is not here."""
    if options.certificate is not None:
        return b"the certificate of this page is from an authority: install that one, ca.pem\n", "text/plain"
    return ((own_folder() if folder is None else folder) / CERTIFICATE).read_bytes(), "application/x-x509-ca-cert"


def _quiet(log: logging.Logger) -> logging.Logger:
    """A logger for the server's own messages: clients that send garbage are no news."""
    quiet = log.getChild("http")
    quiet.setLevel(logging.CRITICAL)
    return quiet
