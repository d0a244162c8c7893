"""A server of motion JPEG on loopback, whose pictures say their number."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

PERIOD_S = 0.02
WIDTH, HEIGHT = 64, 48


def numbered(number: int) -> np.ndarray:
    """A picture of 16 x 1 blocks, black or white, that are the bits of a number; shape (48, 64, 3)."""
    bits = [(number >> bit) & 1 for bit in range(16)]
    row = np.repeat(np.array(bits, dtype=np.uint8) * 255, WIDTH // 16)
    return np.repeat(np.tile(row, (HEIGHT, 1))[:, :, np.newaxis], 3, axis=2)


def number_of(pixels: np.ndarray) -> int:
    """The number that a picture says."""
    blocks = pixels[HEIGHT // 2, WIDTH // 32 :: WIDTH // 16, 0]
    return sum(1 << bit for bit, value in enumerate(blocks) if value > 127)


class StreamServer:
    """Pictures at 50 Hz, numbered from 1, to whoever asks; a context manager."""

    def __init__(self, port: int = 0) -> None:
        self.number = 0
        self.running = threading.Event()
        self.running.set()
        self._ended = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), self._handler())
        self._server.daemon_threads = True
        self.port = self._server.server_address[1]
        self.url = f"http://127.0.0.1:{self.port}/stream.mjpg"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    @staticmethod
    def jpeg(number: int) -> bytes:
        """What it sends as picture `number`."""
        _, jpeg = cv2.imencode(".jpg", numbered(number))
        return jpeg.tobytes()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
                self.end_headers()
                try:
                    while not server._ended.wait(PERIOD_S):
                        if server.running.is_set():
                            server.number += 1
                            jpeg = server.jpeg(server.number)
                            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                            self.wfile.write(head.encode() + jpeg + b"\r\n")
                except OSError:
                    return

            def log_message(self, format: str, *arguments: Any) -> None:
                pass

        return Handler
