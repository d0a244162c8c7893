"""The attacks on HTTP servers pass a small right one, and each of them catches a wrong one."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer, ThreadingHTTPServer
from io import BufferedReader
from typing import Any, ClassVar, override
from urllib.parse import quote

import pytest
from ibrobot_testing import checks, failed_checks
from ibrobot_testing.http import HttpSuite, Served

TOKEN, KEY, PASSWORD = "4dc47a9c9b1e4a0f", "99d3fe0a1c5e4b7d", "correct horse"
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
FOREIGN = ("length", "target", "host", "origin", "site", "frame", "socket", "session")
"""What a request is checked for."""


class Handler(BaseHTTPRequestHandler):
    """A page at `/`, a request that changes something, and a WebSocket."""

    checked: ClassVar[tuple[str, ...]] = FOREIGN
    extra: ClassVar[dict[str, str]] = HEADERS
    flags: ClassVar[str] = "HttpOnly; Path=/; SameSite=Strict"
    methods: ClassVar[tuple[str, ...]] = ("GET", "POST")
    largest: ClassVar[int] = 1000
    request_s: ClassVar[float]
    form: ClassVar[str] = "application/x-www-form-urlencoded"
    protocol_version = "HTTP/1.0"
    server_version, sys_version = "ibrobot", ""
    close_connection = True

    def setup(self) -> None:
        super().setup()
        self.limit = threading.Timer(self.request_s, self.give_up)
        self.limit.daemon = True
        self.limit.start()

    def finish(self) -> None:
        self.limit.cancel()
        super().finish()

    def give_up(self) -> None:
        with contextlib.suppress(OSError):
            self.connection.shutdown(socket.SHUT_RDWR)

    @property
    def own(self) -> str:
        assert isinstance(self.server, HTTPServer)
        return f"127.0.0.1:{self.server.server_port}"

    def allowed(self, check: str) -> bool:
        site = ", ".join(self.headers.get_all("Sec-Fetch-Site", ["none"]))
        opens = site == "same-site" and self.command == "GET" and re.fullmatch(r"/(\?.*)?", self.path)
        document = self.headers.get("Sec-Fetch-Dest") == "document"
        own_site = site in ("none", "same-origin")
        return {
            "length": self.says_where_it_ends,
            "target": self.path.startswith("/"),
            "host": self.headers.get_all("Host") == [self.own],
            "origin": self.headers.get("Origin", f"http://{self.own}") == f"http://{self.own}",
            "site": own_site or bool(opens and "Sec-Fetch-Dest" in self.headers),
            "frame": own_site or document or "Sec-Fetch-Dest" not in self.headers,
            "socket": "Upgrade" not in self.headers or "Origin" in self.headers,
            "session": True,
        }[check]

    def parse_request(self) -> bool:
        assert isinstance(self.rfile, BufferedReader)
        lines = self.rfile.peek().partition(b"\r\n\r\n")[0].split(b"\r\n")
        lengths = [line for line in lines if line.lower().startswith(b"content-length")]
        self.says_where_it_ends = (
            len(lengths) < 2
            and all(re.fullmatch(rb"[!-9;-~]+:[^\r\n]*", line) for line in lines)
            and all(re.fullmatch(rb"[^:]+: [0-9]+", line) for line in lengths)
        )
        return super().parse_request()

    def has_session(self) -> bool:
        return self.headers.get("Cookie") == f"s_{self.own.partition(':')[2]}={KEY}"

    def answer(self) -> None:
        for check in self.checked:
            if check != "session" and not self.allowed(check):
                return self.reply(400 if check == "length" else 403)
        if self.command == "GET" and self.path.startswith("/?token="):
            return self.redeem(self.path.partition("=")[2])
        if self.command == "POST" and self.path == "/login":
            return self.sign_in()
        if "session" in self.checked and not self.has_session():
            return self.reply(401)
        length = int(self.headers.get("Content-Length", 0))
        if "Transfer-Encoding" in self.headers or length > self.largest:
            return self.read_large(length)
        self.rfile.read(length)
        return self.route()

    def read_large(self, length: int) -> None:
        self.reply(413)

    def sign_in(self) -> None:
        length = int(self.headers.get("Content-Length", 0))
        if length > self.largest:
            return self.reply(413)
        form = self.rfile.read(length)
        right = self.headers.get("Content-Type") == self.form and form == f"password={quote(PASSWORD)}".encode()
        return self.redeem(TOKEN if right else "")

    def redeem(self, token: str) -> None:
        if token != TOKEN:
            return self.reply(401)
        cookie = f"s_{self.own.partition(':')[2]}={KEY}"
        return self.reply(303, {"Location": "/", "Set-Cookie": f"{cookie}; {self.flags}"})

    def route(self) -> None:
        known = {"/": "GET", "/change": "POST", "/socket": "GET"}.get(self.path)
        if known is None:
            return self.reply(404)
        if self.command != known and self.command not in self.methods[2:]:
            return self.reply(405)
        return self.reply(101 if self.path == "/socket" else 200)

    def reply(self, status: int, headers: Any = None) -> None:
        self.send_response(status)
        for name, value in {**self.extra, **(headers or {}), "Content-Length": "0"}.items():
            self.send_header(name, value)
        self.end_headers()

    do_GET = do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = do_TRACE = answer

    def log_message(self, format: str, *args: Any) -> None:
        pass


class Server(ThreadingHTTPServer):
    daemon_threads = False
    block_on_close = True
    request_queue_size = 300
    most: ClassVar[int] = 30

    def server_activate(self) -> None:
        self.free = threading.BoundedSemaphore(self.most)
        super().server_activate()

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return self.free.acquire(blocking=False)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class OneAtATime(HTTPServer):
    request_queue_size = 300

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


class Attacks(HttpSuite):
    __test__ = False
    handler: ClassVar[type[Handler]] = Handler
    server: ClassVar[type[HTTPServer]] = Server

    @override
    @contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        handler = type("Limited", (self.handler,), {"request_s": request_s})
        with self.server(("127.0.0.1", 0), handler) as server:
            thread = threading.Thread(target=server.serve_forever, args=(0.01,))
            thread.start()
            url = f"http://127.0.0.1:{server.server_address[1]}"
            try:
                yield Served(url, ("/",), ("/change",), ("/socket",), (f"/?token={TOKEN}",), password=PASSWORD)
            finally:
                server.shutdown()
                thread.join()


class TestSmallServer(Attacks):
    __test__ = True


def without(check: str) -> type[Handler]:
    return type(f"Without_{check}", (Handler,), {"checked": tuple(each for each in FOREIGN if each != check)})


class RefusesItsOwnPage(Handler):
    def route(self):
        return self.reply(403) if self.path == "/change" else super().route()


class IsAProxy(Handler):
    checked = without("target").checked

    def route(self):
        self.path = self.path if self.path.startswith("/") else "/"
        super().route()


class AnswersImagesOfOtherSites(Handler):
    def allowed(self, check):
        return super().allowed(check) or (check == "site" and "Sec-Fetch-Dest" not in self.headers)


class TakesTokensOfHeaders(Handler):
    def has_session(self):
        return super().has_session() or TOKEN in self.headers.get("Authorization", "")


class TakesAPasswordInAnyForm(Handler):
    form = "text/plain"

    def sign_in(self):
        self.headers.replace_header("Content-Type", self.form)
        super().sign_in()


class FailsWithEncodings(Handler):
    def route(self):
        return self.reply(500) if "Content-Encoding" in self.headers else super().route()


class NamesItsKeyToScripts(Handler):
    flags = "Path=/; SameSite=Strict"


class ForgetsAHeader(Handler):
    extra: ClassVar = {name: value for name, value in HEADERS.items() if name != "X-Frame-Options"}


class ServesFiles(Handler):
    def route(self):
        return self.reply(200) if ".." in self.path else super().route()


class TakesPut(Handler):
    methods = ("GET", "POST", "PUT")


class ReadsAll(Handler):
    def read_large(self, length):
        while self.rfile.read(1 << 16):
            pass
        self.reply(413)


class Patient(Handler):
    def setup(self):
        super().setup()
        self.limit.cancel()
        self.connection.settimeout(8)


class AnswersGarbage(Handler):
    def send_error(self, *args, **more):
        self.reply(200)


WRONG = {
    RefusesItsOwnPage: "own_page_is_served",
    without("host"): "another_host_is_refused",
    without("origin"): "another_origin_is_refused",
    AnswersImagesOfOtherSites: "requests_that_another_site_causes_are_refused",
    without("frame"): "another_site_opens_only_the_page",
    without("session"): "nothing_is_served_without_a_session",
    without("socket"): "sockets_need_their_page",
    NamesItsKeyToScripts: "link_leads_to_a_session_and_leaves_the_address",
    IsAProxy: "only_paths_are_served",
    without("length"): "ambiguous_requests_are_refused",
    TakesTokensOfHeaders: "nothing_is_served_without_a_session",
    TakesAPasswordInAnyForm: "only_the_password_signs_in",
    FailsWithEncodings: "broken_bodies_are_the_client_s_fault",
    ForgetsAHeader: "every_answer_has_the_headers",
    ServesFiles: "no_path_leads_to_other_files",
    TakesPut: "other_methods_are_refused",
    ReadsAll: "large_bodies_are_not_read",
    Patient: "unfinished_requests_end",
    AnswersGarbage: "garbage_ends_nothing",
}


@pytest.mark.parametrize(("wrong", "caught_by"), WRONG.items(), ids=lambda v: getattr(v, "__name__", v))
def test_catches(wrong, caught_by, tmp_path):
    class Wrong(Attacks):
        handler = wrong
        patience_s = 1.0 if wrong in (Patient, ReadsAll) else Attacks.patience_s

    assert failed_checks(Wrong, tmp_path) == {caught_by}


def test_catches_a_server_that_waits_for_each_client(tmp_path):
    class Wrong(Attacks):
        server = OneAtATime
        patience_s = 1.0

    assert "silent_clients_delay_nobody" in failed_checks(Wrong, tmp_path)


def test_catches_a_server_that_holds_any_number_of_connections(tmp_path):
    class Boundless(Server):
        most = 1000

    class Wrong(Attacks):
        server = Boundless
        patience_s = 1.0

    assert failed_checks(Wrong, tmp_path) == {"crowd_is_turned_away"}


def test_every_check_catches_something():
    assert checks(HttpSuite) == {*WRONG.values(), "silent_clients_delay_nobody", "crowd_is_turned_away"}
