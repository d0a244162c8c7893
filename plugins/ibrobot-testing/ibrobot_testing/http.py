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
from urllib.parse import quote, urlsplit

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
_AMBIGUOUS = (
    "Content-Length: 6\r\nTransfer-Encoding: chunked", "Content-Length: 6\r\nContent-Length: 0", "Content-Length: 6, 0",
    "Content-Length: +6", "Content-Length: 6\r\n\tX: a", "Content-Length : 6", "Transfer-Encoding: chunked, identity",
    "Transfer-Encoding: xchunked", "Transfer-Encoding: chunked\r\nTransfer-Encoding: chunked",
    "X: a\nContent-Length: 6", "X: a\rContent-Length: 6",
)  # fmt: skip
"""Headers by which two readers disagree on where a request ends."""
_TARGETS = ("http://evil.example/", "https://evil.example{path}", "evil.example:80", "*")
"""Targets of requests that are no path: those of a proxy, and of the server as a whole."""
_BROKEN = (("gzip", b"no gzip"), ("deflate", b"\xff\xff"), ("gzip", b""))
"""Encoding of a body -> what is not encoded so."""
_CROWD = 260
"""Connections, which are more than a server should hold."""
_FORM = "application/x-www-form-urlencoded"
_NO_PASSWORDS = (
    (_FORM, b""), (_FORM, b"password="), (_FORM, b"password=x"), (_FORM, b"password=%00"), (_FORM, b"password=\xff%ff"),
    (_FORM, b"password"), (_FORM, b"&" * 3000), (_FORM, b"password=" + b"a" * 60_000),
    ("multipart/form-data", b"x"), ("multipart/form-data; boundary=x", b"--x\r\n\r\n--x--"),
    (f"{_FORM}; charset=none", b"password=x"), ("application/json", b'{"password": true}'),
)  # fmt: skip
"""Type -> form that does not have the password."""
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
    password: str | None = None
    """Opens a session by the form of `POST /login`; None if the server has none."""

    @property
    def host(self) -> str:
        """Host and port of the address."""
        return urlsplit(self.url).netloc

    def reach(self, patience_s: float) -> socket.socket:
        """A connection on which nothing was sent."""
        return socket.create_connection(("127.0.0.1", urlsplit(self.url).port or 0), timeout=patience_s)

    def connect(self, patience_s: float) -> socket.socket:
        """A connection, on which TLS is established if the server has it."""
        plain = self.reach(patience_s)
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

    def ask(
        self, served: Served, path: str, headers: Headers = (), *, method: str = "GET", cookie: str = "",
        body: bytes = b"",
    ) -> Answer:  # fmt: skip
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
            length = (("Content-Length", str(len(body))),) if method == "POST" or body else ()
            for name, value in (*own, *length, *headers, *((("Cookie", cookie),) if cookie else ())):
                connection.putheader(name, value)
            connection.endheaders(body)
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

    def test_only_paths_are_served(self) -> None:
        """The server is no proxy, and no other host in a request line stands beside its own in `Host`."""
        with self.served() as (served, cookie):
            for method, path, needed in served.requests():
                for target in (each.format(path=path) for each in _TARGETS):
                    answer = self.ask(served, target, needed, method=method, cookie=cookie)
                    assert answer.status in (400, 403, 404, 405), f"{method} {target} is answered with {answer.status}"
                    assert "Set-Cookie" not in answer.headers

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
                self.refused(served, cookie, [("Sec-Fetch-Site", "none"), ("Sec-Fetch-Site", site)])

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
        """Nor with an empty, made-up or truncated cookie, a wrong name, or a token in the wrong place."""
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
            for count, answer in enumerate(self._misplaced(served, name)):
                assert answer.status in (401, 403, 404, 405), f"attempt {count} is answered with {answer.status}"
                assert "Set-Cookie" not in answer.headers

    def _misplaced(self, served: Served, cookie: str) -> Iterator[Answer]:
        """Answers to requests that have their token elsewhere than in a link."""
        path = served.reads[-1]
        for link in served.links:
            query, token = link[2:], link.partition("=")[2]
            yield self.ask(served, path, [("Authorization", f"Bearer {token}")])
            yield self.ask(served, path, [("X-Token", token)], cookie=f"token={token}; {cookie}={token}")
            elsewhere = (f"{path}?{query}", f"/;{query}", f"/%2f?{query}", f"/?token=x&{query}", f"/?Token={token}")
            for target in elsewhere:
                if target != link:
                    yield self.ask(served, target)
            yield self.ask(served, link, method="POST")
            yield self.ask(served, "/", [("Content-Type", _FORM)], method="POST", body=query.encode())

    def test_only_the_password_signs_in(self) -> None:
        """Forms without it, and what is no form, are refused, and break nothing."""
        with self.served() as (served, _):
            if served.password is None:
                return
            for kind, body in _NO_PASSWORDS:
                answer = self.ask(served, "/login", [("Content-Type", kind)], method="POST", body=body)
                assert answer.status in (400, 401, 413), f"{kind} {body[:40]!r} is answered with {answer.status}"
                assert "Set-Cookie" not in answer.headers
            right = f"password={quote(served.password)}".encode()
            for kind, status in (("text/plain", 401), (_FORM, 303)):
                answer = self.ask(served, "/login", [("Content-Type", kind)], method="POST", body=right)
                assert answer.status == status, kind

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
                assert "/" not in answer.headers.get("Server", ""), "the version of the server"

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

    def test_ambiguous_requests_are_refused(self) -> None:
        """A request whose end is not certain could carry a second one past a proxy."""
        with self.served() as (served, cookie):
            path = served.writes[0] if served.writes else served.reads[0]
            for headers in _AMBIGUOUS:
                head = f"POST {path} HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\n{headers}\r\n"
                with served.connect(self.patience_s) as client, contextlib.suppress(OSError):
                    client.sendall(f"{head}Content-Type: application/json\r\n\r\n0\r\n\r\nG".encode())
                    status = client.recv(100).split(b" ")[1:2]
                    assert status in ([], [b"400"], [b"413"], [b"501"]), f"{headers!r} is answered with {status}"

    def test_broken_bodies_are_the_client_s_fault(self) -> None:
        """A body that is not encoded as its header says is no failure of the server."""
        with self.served() as (served, cookie):
            for method, path, needed in served.requests():
                for encoding, body in _BROKEN if path not in served.sockets else ():
                    headers = (*needed, ("Content-Encoding", encoding))
                    status = self.ask(served, path, headers, method=method, cookie=cookie, body=body).status
                    assert status < 500, f"{method} {path} with a body that is no {encoding}"

    def test_large_bodies_are_not_read(self) -> None:
        """With their length beforehand or without, for every path."""
        with self.served() as (served, cookie):
            for path in (*served.writes[:3], served.reads[0]):
                for length in (f"Content-Length: {_LARGE << 20}", "Transfer-Encoding: chunked"):
                    head = f"POST {path} HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\n{length}\r\n"
                    with served.connect(self.patience_s) as client:
                        client.sendall(f"{head}Content-Type: application/json\r\n\r\n".encode())
                        assert _sent(client, chunked="chunked" in length) < _LARGE / 2, f"{path} {length}"

    def test_crowd_is_turned_away(self) -> None:
        """Connections are limited, from before any handshake: files that a process may open are, too."""
        with self.serve(3600.0) as served, contextlib.ExitStack() as stack:
            crowd = [stack.enter_context(served.reach(self.patience_s)) for _ in range(_CROWD)]
            ended, _, _ = select.select(crowd, [], [], self.patience_s)
            assert ended, f"{_CROWD} connections are held"

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
