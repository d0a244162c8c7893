"""`ibrobot camera preview`: shows cameras in a browser, on this machine or through an SSH tunnel."""

from __future__ import annotations

import html
import secrets
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import attrs

from ibrobot_core.api import SensorError, option
from ibrobot_core.app import echo, on_signals

if TYPE_CHECKING:
    from ibrobot_camera.camera import OpenCvCamera

_BOUNDARY = "picture"


class Newest:
    """The newest image of one camera as a JPEG, for any number of viewers."""

    def __init__(self, name: str, camera: OpenCvCamera, ended: threading.Event) -> None:
        self.name = name
        self._camera = camera
        self._ended = ended
        self._changed = threading.Condition()
        self._jpeg = b""
        self._number = 0
        self.problem = ""
        self.thread = threading.Thread(target=self._run, name=f"preview {name}", daemon=True)

    def after(self, number: int, timeout_s: float) -> tuple[int, bytes]:
        """The first image newer than `number`, with its number; empty if none arrived in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout_s)
            return (self._number, self._jpeg) if self._number > number else (number, b"")

    def _run(self) -> None:
        from ibrobot_camera.commands.sources import browser_jpeg

        while not self._ended.is_set():
            try:
                image = self._camera.read(0.2)
            except SensorError as error:
                self.problem = str(error)
                self._ended.set()
                return
            if image is None:
                continue
            jpeg = browser_jpeg(image)
            with self._changed:
                self._jpeg, self._number = jpeg, self._number + 1
                self._changed.notify_all()


@attrs.frozen(kw_only=True)
class Preview:
    """Show the cameras of SOURCE in a browser.

    Prints the page's address, which contains a secret token. Without --host, only this machine can open it. To open it
    from another machine, set --port and run `ssh -L 8000:127.0.0.1:PORT robot`. Ctrl-C ends it.
    """

    source: str = option(typed="SOURCE", help="a device, or a robot YAML")
    host: str = option("127.0.0.1", help="address to listen on")
    port: int = option(0, ge=0, le=65535, help="0: any free port")
    seconds: float | None = option(None, ge=0, help="stop after this many seconds")

    def __call__(self) -> None:
        from ibrobot_camera.commands.sources import opened

        ended = threading.Event()
        on_signals(ended.set)
        token = secrets.token_urlsafe(16)
        with opened(self.source) as cameras:
            views = {name: Newest(name, camera, ended) for name, camera in cameras.items()}
            server = ThreadingHTTPServer((self.host, self.port), _handler(views, token, ended))
            server.daemon_threads = True
            for thread in (*(view.thread for view in views.values()), threading.Thread(target=server.serve_forever)):
                thread.start()
            echo(f"http://{self.host}:{server.server_address[1]}/?token={token}")
            ended.wait(self.seconds)
            ended.set()
            server.shutdown()
            server.server_close()
            for view in views.values():
                view.thread.join()
        for view in views.values():
            if view.problem:
                raise SensorError(view.problem)


def _handler(views: dict[str, Newest], token: str, ended: threading.Event) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Serves the page, and a stream of images for each camera."""

        def do_GET(self) -> None:
            """Answer a browser that knows the token."""
            address = urlsplit(self.path)
            given = parse_qs(address.query).get("token", [""])[0]
            if not secrets.compare_digest(given, token):
                self.send_error(403)
            elif address.path == "/":
                self._page()
            elif (name := address.path.removeprefix("/stream/")) in views:
                self._stream(views[name])
            else:
                self.send_error(404)

        def log_message(self, format: str, *arguments: Any) -> None:
            """Print nothing: the terminal shows the address."""

        def _page(self) -> None:
            figures = "".join(
                f'<figure><img src="/stream/{name}?token={token}" alt="{html.escape(name)}">'
                f"<figcaption>{html.escape(name)}</figcaption></figure>"
                for name in views
            )
            body = (
                '<!doctype html><html lang="en"><meta charset="utf-8"><title>ibrobot cameras</title><style>'
                "body{margin:1em;background:#111;color:#eee;font-family:sans-serif;display:flex;flex-wrap:wrap;gap:1em}"
                "figure{margin:0}img{max-width:100%;min-width:20em;background:#333}</style>" + figures
            ).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def _stream(self, view: Newest) -> None:
            self.send_response(200)
            self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            number = 0
            try:
                while not ended.is_set():
                    number, jpeg = view.after(number, 0.5)
                    if not jpeg:
                        continue
                    head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
                    self.wfile.write(f"{head}\r\n".encode() + jpeg + b"\r\n")
            except OSError:
                return  # the browser has gone

    return Handler
