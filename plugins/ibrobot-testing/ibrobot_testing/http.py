"""The attacks that every HTTP server here must withstand."""

from __future__ import annotations

import contextlib
import http.client
import select
import socket
import ssl
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import ClassVar
from urllib.parse import urlsplit

import attrs

from ibrobot_testing.suite import Suite

_LARGE = 100
"""Size of a large body [MiB]."""
_HEADERS = {
    "Content-Security-Policy": ("default-src 'none'", "frame-ancestors 'none'", "base-uri 'none'"),
    "X-Content-Type-Options": ("nosniff",),
    "X-Frame-Options": ("DENY",),
    "Referrer-Policy": ("no-referrer",),
    "Cache-Control": ("no-",),
    "Cross-Origin-Opener-Policy": ("same-origin",),
    "Cross-Origin-Resource-Policy": ("same-origin",),
}
"""Header -> what it contains."""
_FILES = (
    "/static/../server.py", "/static/..%2fserver.py", "/static/%2e%2e/server.py", "/static//etc/passwd",
    "/../etc/passwd", "/static/....//server.py", "/static/%00", "/%2e%2e%2f%2e%2e%2fetc%2fpasswd", "/static/py.typed",
)  # fmt: skip
_GARBAGE = (
    b"G", b"\x16\x03\x01\x00\xa5", b"GET / HTTP/9.9\r\n\r\n", b"GET / HTTP/1.1\r\nContent-Length: x\r\n\r\n",
    b"POST / HTTP/1.1\r\nTransfer-Encoding: y\r\n\r\n", b"\x00" * 100, b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: " + b"a" * 70_000 + b"\r\n\r\n", b"\xff\xfe\r\n\r\n",
)  # fmt: skip
_WEBSOCKET = (
    ("Connection", "Upgrade"),
    ("Upgrade", "websocket"),
    ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "AAAAAAAAAAAAAAAAAAAAAA=="),
)

Headers = Sequence[tuple[str, str]]


@attrs.frozen
class Served:
    """A server that is attacked."""

    url: str
    """Its address, e.g. `http://127.0.0.1:8080`."""
    reads: tuple[str, ...]
    """Paths that answer a GET."""
    writes: tuple[str, ...] = ()
    """Paths that answer a POST."""
    sockets: tuple[str, ...] = ()
    """Paths of WebSockets."""
    links: tuple[str, ...] = ()
    """Paths that open a session, with their token; none if no session is needed."""
    other_sites_link: bool = False
    """Whether a link on any other site may open the page."""
    any_port: bool = False
    """Whether clients may name another port."""

    @property
    def host(self) -> str:
        """Host and port of the address."""
        return urlsplit(self.url).netloc

    def connect(self, patience_s: float) -> socket.socket:
        """A connection, on which TLS is established if the server has it."""
        plain = socket.create_connection(("127.0.0.1", urlsplit(self.url).port or 0), timeout=patience_s)
        return plain if self.url.startswith("http:") else _unchecked().wrap_socket(plain)

    def requests(self) -> Iterator[tuple[str, str, Headers]]:
        """Method, path and necessary headers of every request."""
        yield from (("GET", path, ()) for path in (*self.reads, *self.links))
        yield from (("POST", path, ()) for path in self.writes)
        yield from (("GET", path, (*_WEBSOCKET, ("Origin", self.url))) for path in self.sockets)


@attrs.frozen
class Answer:
    """An answer to a request."""

    status: int
    headers: http.client.HTTPMessage
    body: bytes


class HttpSuite(Suite[Served]):
    """Attacks on a server. The subclass defines `serve`.

    Attributes:
        patience_s: time for an answer, or for a connection to end [s].
    """

    patience_s: ClassVar[float] = 30.0

    def serve(self, request_s: float) -> AbstractContextManager[Served]:
        """Serve, and give clients `request_s` to send a request [s]."""
        raise NotImplementedError(f"{type(self).__name__} must define serve(self, request_s)")

    def ask(self, served: Served, path: str, headers: Headers = (), *, method: str = "GET", cookie: str = "") -> Answer:
        """The answer to a request, which has the header `Host` unless `headers` has one."""
        address, port = "127.0.0.1", urlsplit(served.url).port
        connection = (
            http.client.HTTPConnection(address, port, timeout=self.patience_s)
            if served.url.startswith("http:")
            else http.client.HTTPSConnection(address, port, timeout=self.patience_s, context=_unchecked())
        )
        with contextlib.closing(connection):
            connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            own = () if any(name == "Host" for name, _ in headers) else (("Host", served.host),)
            length = (("Content-Length", "0"),) if method == "POST" else ()
            for name, value in (*own, *length, *headers, *((("Cookie", cookie),) if cookie else ())):
                connection.putheader(name, value)
            connection.endheaders()
            response = connection.getresponse()
            return Answer(response.status, response.headers, response.read())

    def cookie(self, served: Served) -> str:
        """The cookie of a new session; empty if none is needed."""
        if not served.links:
            return ""
        set_cookie: str = self.ask(served, served.links[0]).headers["Set-Cookie"]
        return set_cookie.partition(";")[0]

    @contextmanager
    def served(self, request_s: float = 3600.0) -> Iterator[tuple[Served, str]]:
        """The server, and the cookie of a session."""
        with self.serve(request_s) as served:
            yield served, self.cookie(served)

    def refused(self, served: Served, cookie: str, changes: Headers, statuses: Sequence[int] = (403,)) -> None:
        """Check that every request with changed headers is refused."""
        changed = {name for name, _ in changes}
        for method, path, needed in served.requests():
            headers = (*(each for each in needed if each[0] not in changed), *changes)
            answer = self.ask(served, path, headers, method=method, cookie=cookie)
            assert answer.status in statuses, f"{method} {path} with {changes} is answered with {answer.status}"
            assert "Set-Cookie" not in answer.headers

    def test_own_page_is_served(self) -> None:
        """With a session, from the page itself, every request is answered."""
        with self.served() as (served, cookie):
            for method, path, needed in served.requests():
                answer = self.ask(served, path, needed, method=method, cookie=cookie)
                assert answer.status < 500, f"{method} {path}"
                assert answer.status not in (401, 403, 404, 405), f"{method} {path}"
                assert (answer.status == 101) == bool(needed), f"{method} {path}"

    def test_another_host_is_refused(self) -> None:
        """No web page under another name that resolves to this machine learns or changes anything."""
        with self.served() as (served, cookie):
            name, _, port = served.host.rpartition(":")
            hosts = ["evil.example", f"evil.example:{port}", f"{name}.evil.example:{port}", f"{name}.:{port}", ""]
            for host in (*hosts, "127.0.0.2", *(() if served.any_port else (name, f"{name}:1"))):
                self.refused(served, cookie, [("Host", host)])
            self.refused(served, cookie, [("Host", served.host), ("Host", "evil.example")], (400, 403))

    def test_another_origin_is_refused(self) -> None:
        """Scripts of other sites, and of other servers of this machine, learn and change nothing."""
        with self.served() as (served, cookie):
            other = "https" if served.url.startswith("http:") else "http"
            for origin in ("http://evil.example", "null", "", f"http://{served.host}1", f"{other}://{served.host}"):
                self.refused(served, cookie, [("Origin", origin)])

    def test_requests_that_another_site_causes_are_refused(self) -> None:
        """As browsers say with `Sec-Fetch-Site`, e.g. for an image or a form of another site."""
        with self.served() as (served, cookie):
            for site in ("cross-site", "same-site", "?"):
                self.refused(served, cookie, [("Sec-Fetch-Site", site)])

    def test_another_site_opens_only_the_page(self) -> None:
        """In a tab, by a link on this machine or, if that is allowed, on any site; never in a frame."""
        with self.served() as (served, cookie):
            for site in ("same-site", "cross-site"):
                opens = bool(served.links) and (site == "same-site" or served.other_sites_link)
                for kind in ("document", "iframe"):
                    headers = [("Sec-Fetch-Site", site), ("Sec-Fetch-Mode", "navigate"), ("Sec-Fetch-Dest", kind)]
                    for path in ("/", *served.links):
                        status = self.ask(served, path, headers, cookie=cookie).status
                        assert (status in (200, 303)) == (opens and kind == "document"), f"{path} {headers}"
                    for path in {*served.reads} - {"/"}:
                        assert self.ask(served, path, headers, cookie=cookie).status == 403, path

    def test_nothing_is_served_without_a_session(self) -> None:
        """Neither without one, nor with one that is made up, nor with a wrong token."""
        with self.served() as (served, cookie):
            name = cookie.partition("=")[0]
            for wrong in ("", f"{name}=", f"{name}=x", cookie[:-1], f"x{cookie}") if served.links else ():
                for method, path, needed in served.requests():
                    if path not in served.links:
                        answer = self.ask(served, path, needed, method=method, cookie=wrong)
                        assert answer.status == 401, f"{method} {path} with {wrong!r}"
            for token in ("", "x", "x" * 32, "%00", "%C3%A9", *(link.partition("=")[2][:-1] for link in served.links)):
                answer = self.ask(served, f"/?token={token}")
                assert "Set-Cookie" not in answer.headers, token
                assert not served.links or answer.status == 401, token

    def test_link_leads_to_a_session_and_leaves_the_address(self) -> None:
        """Scripts cannot read the cookie, other sites cannot use it, and other ports have another one."""
        with self.served() as (served, _):
            for link in served.links:
                answer = self.ask(served, link)
                assert (answer.status, answer.headers["Location"]) == (303, "/")
                name, *flags = answer.headers["Set-Cookie"].split("; ")
                assert served.host.rpartition(":")[2] in name.partition("=")[0]
                assert link.partition("=")[2] not in name
                secure = served.url.startswith("https:")
                wanted = {"HttpOnly", "Path=/", f"SameSite={'Lax' if served.other_sites_link else 'Strict'}"}
                assert set(flags) == wanted | ({"Secure"} if secure else set())
                assert name.startswith("__Host-") == secure

    def test_sockets_need_their_page(self) -> None:
        """A WebSocket that does not state an origin is refused."""
        with self.served() as (served, cookie):
            for path in served.sockets:
                assert self.ask(served, path, _WEBSOCKET, cookie=cookie).status == 403, path

    def test_every_answer_has_the_headers(self) -> None:
        """Scripts only from here, no frames, no referrer, no copies: for pages and for refusals."""
        with self.served() as (served, cookie):
            answers = [self.ask(served, path, cookie=cookie) for path in (*served.reads, "/nothing", *served.links)]
            answers += [self.ask(served, path) for path in served.reads]
            answers += [self.ask(served, "/", [("Host", "evil.example")]), self.ask(served, "/", method="DELETE")]
            for answer in answers:
                for name, parts in _HEADERS.items():
                    assert all(part in answer.headers.get(name, "") for part in parts), f"{name} of {answer.status}"
                assert "unsafe" not in answer.headers["Content-Security-Policy"]

    def test_no_path_leads_to_other_files(self) -> None:
        """Only the files of the page are served."""
        with self.served() as (served, cookie):
            for path in _FILES:
                assert self.ask(served, path, cookie=cookie).status == 404, path

    def test_other_methods_are_refused(self) -> None:
        """Nothing but GET and POST, each where it belongs."""
        with self.served() as (served, cookie):
            for path in served.reads:
                methods = ("PUT", "DELETE", "PATCH", "OPTIONS", "TRACE")
                for method in methods if path in served.writes else (*methods, "POST"):
                    assert self.ask(served, path, method=method, cookie=cookie).status == 405, f"{method} {path}"

    def test_unfinished_requests_end(self) -> None:
        """Clients that send a request by half, or a byte now and then, are disconnected."""
        with self.served(0.5) as (served, cookie):
            path = served.writes[0] if served.writes else served.reads[0]
            head = f"Host: {served.host}\r\nContent-Type: application/json\r\nContent-Length: 9\r\nCookie: {cookie}\r\n"
            body = f"{'POST' if served.writes else 'GET'} {path} HTTP/1.1\r\n{head}\r\n{{"
            for begin in ("", "GET / HTTP/1.1\r\nHost: x\r\nX-A: ", body):
                with served.connect(self.patience_s) as client:
                    client.sendall(begin.encode())
                    assert self._ends(client, drips=begin.endswith(" ")), begin

    def _ends(self, client: socket.socket, *, drips: bool) -> bool:
        """Whether the server closes a connection, even if the client sends a byte now and then."""
        client.settimeout(0.1)
        for _ in range(int(self.patience_s / 0.1)):
            try:
                if client.recv(4096) == b"":
                    return True
            except TimeoutError:
                with contextlib.suppress(OSError):
                    client.sendall(b"a" if drips else b"")
            except OSError:
                return True
        return False

    def test_garbage_ends_nothing(self) -> None:
        """What is no HTTP, or too much of it, is dropped; the next request is answered."""
        with self.served() as (served, cookie):
            for garbage in _GARBAGE:
                with served.connect(self.patience_s) as client, contextlib.suppress(OSError):
                    client.sendall(garbage)
                    client.shutdown(socket.SHUT_WR)
                    assert b" 200 " not in client.recv(100)
            assert self.ask(served, served.reads[0], cookie=cookie).status < 500

    def test_large_bodies_are_not_read(self) -> None:
        """With their length beforehand or without, for every path."""
        with self.served() as (served, cookie):
            for path in (*served.writes[:3], served.reads[0]):
                for length in (f"Content-Length: {_LARGE << 20}", "Transfer-Encoding: chunked"):
                    head = f"POST {path} HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\n{length}\r\n"
                    with served.connect(self.patience_s) as client:
                        client.sendall(f"{head}Content-Type: application/json\r\n\r\n".encode())
                        assert _sent(client, chunked="chunked" in length) < _LARGE / 2, f"{path} {length}"

    def test_silent_clients_delay_nobody(self) -> None:
        """Many clients may connect and send nothing."""
        with self.serve(3600.0) as served, contextlib.ExitStack() as silent:
            for _ in range(20):
                silent.enter_context(served.connect(self.patience_s))
            assert self.ask(served, served.reads[0], cookie=self.cookie(served)).status < 500


def _sent(client: socket.socket, *, chunked: bool) -> int:
    """How much of a large body is sent until the server answers or closes the connection [MiB]."""
    piece = bytes(1 << 20)
    for count in range(_LARGE):
        if select.select([client], [], [], 0)[0]:
            return count
        try:
            client.sendall(b"100000\r\n%s\r\n" % piece if chunked else piece)
        except OSError:
            return count
    return _LARGE


def _unchecked() -> ssl.SSLContext:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context
