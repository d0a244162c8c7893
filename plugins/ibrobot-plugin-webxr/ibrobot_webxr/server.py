"""The server of the page, in a thread of its own: HTTPS, and a WebSocket for each open page."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import attrs
from aiohttp import WSMsgType, web
from ibrobot_http.certificates import CERTIFICATE
from ibrobot_http.files import add_files
from ibrobot_http.guard import Guard
from ibrobot_http.server import ServerThread

from ibrobot_core.api import Clock, RobotStatus
from ibrobot_core.app import Bus, error_text
from ibrobot_webxr.certificate import open_port, own_folder
from ibrobot_webxr.exchange import Delays, Exchange
from ibrobot_webxr.images import CameraImages
from ibrobot_webxr.messages import LONGEST, Claim, Hands, Press, Shown, Stop, decode
from ibrobot_webxr.options import HANDS, WebxrOptions

_STATE_S = 0.1
"""Period of the states sent to pages [s]."""
_SILENT_S = 1.0
"""A page that sends nothing for this long loses control [s]."""
_CHECK_S = 10.0
"""Longest time for trying out an emergency stop at the start [s]."""
_MOST_PAGES = 8
_MOST_REFUSED = 100
"""Wrong messages after which a page is disconnected."""
_PERMISSIONS = "xr-spatial-tracking=(self), accelerometer=(self), gyroscope=(self), magnetometer=(self)"


@attrs.define(eq=False)
class _Page:
    """An open page."""

    socket: web.WebSocketResponse
    delays: Delays = attrs.field(factory=Delays)
    heard_s: float = attrs.field(factory=time.monotonic)
    """When its last message came [s]."""
    sent: dict[str, int] = attrs.field(factory=dict)
    """Camera -> number of the newest image sent."""
    unacknowledged: set[str] = attrs.field(factory=set)
    """Cameras whose last image the page has not acknowledged yet."""
    refused: int = 0
    error: str = ""
    """Why its last wrong message was refused."""


class PageServer:
    """Serves the page until `close`. The first open page has control; others watch.

    Args:
        options: the address, the certificate, the cameras.
        clock: the clock of the run.
        bus: the bus of the run, for images, status and the emergency stop.
        log: where the server reports.

    Attributes:
        exchange: the poses of the page.
        port: the port.

    Raises:
        TeleopError: if the certificate cannot be used or the address is not available.
    """

    def __init__(self, options: WebxrOptions, clock: Clock, bus: Bus, log: logging.Logger) -> None:
        listener = open_port(options)
        # A scanned code counts as a link from another site on some phones.
        self._guard = Guard(listener, roles=("drive",), other_sites_link=True, permissions=_PERMISSIONS)
        self._options = options
        self._bus = bus
        self._log = log
        self._images = CameraImages(bus, options.cameras, log)
        self._status = bus.subscribe("/robot_status", 1)
        self._robot: RobotStatus | None = None
        self._pages: list[_Page] = []
        self._control: _Page | None = None
        self._refused: Counter[str] = Counter()
        self.exchange = Exchange(clock)
        self.port = listener.port
        app = web.Application(client_max_size=LONGEST)
        add_files(app, Path(__file__).parent / "page")
        app.router.add_get("/certificate.pem", self._certificate, allow_head=False)
        app.router.add_get("/socket", self._socket, allow_head=False)
        app.on_shutdown.append(self._close_pages)
        # Its thread exists from the trial on; one that a stop had to start might not start.
        self._stops = ThreadPoolExecutor(1, "webxr stop")
        self._server: ServerThread | None = None
        try:
            self._stops.submit(self._call_if_served, "/estop/check").result(_CHECK_S)
            self._server = ServerThread(self._guard, app, "webxr page", close_s=0.1, beside=self._send_states)
        except BaseException:
            self.close()
            raise

    @property
    def address(self) -> str:
        """The address that logs a browser in, with the token."""
        return self._guard.link("drive")

    def close(self) -> None:
        """Stop the server. Safe to call twice."""
        if self._server is not None:
            self._server.close()
        self._guard.listener.socket.close()
        self._stops.shutdown(wait=False)
        self._images.close()
        self._status.close()

    async def _close_pages(self, app: web.Application) -> None:
        for page in tuple(self._pages):
            with contextlib.suppress(OSError, RuntimeError, asyncio.TimeoutError):
                await asyncio.wait_for(page.socket.close(), 0.5)

    async def _certificate(self, request: web.Request) -> web.StreamResponse:
        """The certificate that a phone installs to trust the page; a hint if an authority issued it."""
        if self._options.certificate is not None:
            return web.Response(text="the certificate of this page is from an authority: install that one, ca.pem\n")
        trusted = (own_folder() / CERTIFICATE).read_bytes()
        return web.Response(body=trusted, content_type="application/x-x509-ca-cert")

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if len(self._pages) >= _MOST_PAGES:
            return web.Response(status=503, text=f"{_MOST_PAGES} pages are open: close one\n")
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
                    await self._handle(page, message.data)
                if page.refused >= _MOST_REFUSED:
                    break
        finally:
            sending.cancel()
            self._pages.remove(page)
            self._release(page)
            await socket.close()
        return socket

    async def _handle(self, page: _Page, text: str) -> None:
        """Handle a message of a page."""
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
                # The page measures the round trip by the echo, and notices a lost network. A page that has just lost
                # control needs it, too.
                await page.socket.send_str(f'{{"type":"echo","n":{message.number}}}')
            case Press(event):
                if page is self._control:
                    self.exchange.press(event)

    async def _stop(self) -> None:
        """Stop the robot, in any mode."""
        self.exchange.stop()
        try:
            await asyncio.get_running_loop().run_in_executor(self._stops, self._call_if_served, "/estop")
        except Exception as error:  # noqa: BLE001 - contained: the device in `read` stops the robot, too
            self._log.error("webxr: the emergency stop failed: %s", error_text(error))

    def _call_if_served(self, service: str) -> None:
        if self._bus.serves(service):
            self._bus.call(service)

    def _next_image(self, page: _Page, camera: int) -> None:
        names = self._images.names
        if camera >= len(names):
            self._refuse(page, f"camera: must be below {len(names)}")
            return
        page.unacknowledged.discard(names[camera])

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

    async def _send_states(self) -> None:
        """Send the state to all pages, periodically."""
        while True:
            began_s = time.monotonic()
            await asyncio.sleep(_STATE_S)
            now_s = time.monotonic()
            if self._control is not None:
                # A pause of this thread does not count as the page's silence.
                self._control.heard_s += max(0.0, now_s - began_s - _STATE_S)
                if now_s - self._control.heard_s > _SILENT_S:
                    self._release(self._control)
            if not self._pages:
                self._images.refresh()  # so that a page does not open with an old image
            if (received := self._status.get()) is not None:
                assert isinstance(received.message, RobotStatus)
                self._robot = received.message
            await asyncio.gather(*(self._send_state(page) for page in self._pages if not page.socket.closed))

    async def _send_state(self, page: _Page) -> None:
        with contextlib.suppress(OSError, RuntimeError, asyncio.TimeoutError):
            # A page that stops reading must not delay the others; its heartbeat disconnects it.
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
            "cameras": self._images.names,
            "error": page.error,
            "robot": None
            if robot is None
            else {"name": robot.robot, "mode": robot.mode, "estop": robot.estop, "faults": list(robot.faults)},
        }

    async def _send_images(self, page: _Page) -> None:
        """Send each camera's newest image, after the page acknowledges the previous one."""
        images = self._images
        while not page.socket.closed:
            await asyncio.sleep(1 / self._options.image_rate)
            images.refresh()
            for index, name in enumerate(images.names):
                number, data = images.newest.get(name, (0, b""))
                if number > page.sent.get(name, 0) and name not in page.unacknowledged:
                    page.sent[name] = number
                    page.unacknowledged.add(name)
                    with contextlib.suppress(OSError, RuntimeError):
                        await page.socket.send_bytes(bytes([min(index, 255)]) + data)
