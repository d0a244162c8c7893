"""The broadcast of states and pictures to all pages: each frame is made once, and every page gets the newest.

A page has credits: it acknowledges each frame, and gets the next one of a channel once few enough are on their way. A
slow page therefore skips frames; it neither delays other pages nor lets memory grow.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from aiohttp import web

from ibrobot_web.link import FIRST_PICTURE

CREDITS, PICTURE_CREDITS = 2, 1
"""Frames of a channel that may be on their way to a page; of pictures fewer, so that none is old when it is shown."""
_DRAIN_S = 0.02
_GONE_S = 10.0
"""Time without an acknowledgement after which a page is disconnected [s]."""


class Page:
    """The stream of one page."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        self._socket = socket
        self._waiting: dict[int, bytes] = {}
        self._flying: dict[int, int] = {}
        self._wake = asyncio.Event()
        self.wanted: frozenset[int] | None = None
        """Channels that the page shows; None for all."""

    def offer(self, channel: int, frame: bytes) -> None:
        """Replace the waiting frame of a channel."""
        if self.wanted is None or channel in self.wanted:
            self._waiting[channel] = frame
            self._wake.set()

    @property
    def behind(self) -> bool:
        """Whether frames wait, or are on their way."""
        return bool(self._waiting) or any(self._flying.values())

    def acknowledge(self, channel: int) -> None:
        """The page has taken a frame of this channel."""
        if self._flying.get(channel, 0) > 0:
            self._flying[channel] -= 1
            self._wake.set()

    async def send(self) -> None:
        """Send frames until the page is gone."""
        while not self._socket.closed:
            ready = [channel for channel in self._waiting if self._flying.get(channel, 0) < _credits(channel)]
            if not ready:
                self._wake.clear()
                waits = bool(self._waiting)
                try:
                    await asyncio.wait_for(self._wake.wait(), _GONE_S)
                except TimeoutError:
                    if waits:
                        return
                continue
            for channel in ready:
                self._flying[channel] = self._flying.get(channel, 0) + 1
                async with asyncio.timeout(_GONE_S):
                    await self._socket.send_bytes(self._waiting.pop(channel))


def _credits(channel: int) -> int:
    return PICTURE_CREDITS if channel >= FIRST_PICTURE else CREDITS


class Broadcast:
    """All pages, and the newest frame of each channel that stays valid.

    Args:
        on_change: called when pages come or go, or show other channels.
        kept: channels whose newest frame a new page gets at once.
    """

    def __init__(self, on_change: Callable[[], None], kept: frozenset[int]) -> None:
        self.pages: set[Page] = set()
        self._on_change = on_change
        self._kept = kept
        self._newest: dict[int, bytes] = {}

    def publish(self, channel: int, payload: bytes | memoryview) -> None:
        """Send a frame to all pages."""
        frame = bytes((channel,)) + payload
        if channel in self._kept:
            self._newest[channel] = frame
        for page in self.pages:
            page.offer(channel, frame)

    async def drain(self, timeout_s: float) -> None:
        """Wait until the frames that wait are sent to all pages, but no longer than a time [s]."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while any(page.behind for page in self.pages):
                    await asyncio.sleep(_DRAIN_S)

    @property
    def wanted(self) -> frozenset[int] | None:
        """Channels that any page shows; None for all."""
        channels: set[int] = set()
        for page in self.pages:
            if page.wanted is None:
                return None
            channels |= page.wanted
        return frozenset(channels)

    async def serve(self, socket: web.WebSocketResponse) -> None:
        """Stream to a page until it is gone."""
        page = Page(socket)
        self.pages.add(page)
        self._on_change()
        for channel, frame in self._newest.items():
            page.offer(channel, frame)
        sending = asyncio.create_task(page.send())
        receiving = asyncio.create_task(self._receive(page, socket))
        try:
            await asyncio.wait((sending, receiving), return_when=asyncio.FIRST_COMPLETED)
        finally:
            self.pages.discard(page)
            self._on_change()
            for task in (sending, receiving):
                task.cancel()
            await asyncio.gather(sending, receiving, return_exceptions=True)
            await socket.close()

    async def _receive(self, page: Page, socket: web.WebSocketResponse) -> None:
        """Acknowledgements, one byte each: a channel. A longer message lists the channels that the page shows."""
        async for message in socket:
            if not isinstance(message.data, bytes):
                return
            if len(message.data) == 1:
                page.acknowledge(message.data[0])
            else:
                page.wanted = frozenset(message.data[1:])
                self._on_change()
