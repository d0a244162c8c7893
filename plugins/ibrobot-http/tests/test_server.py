"""Servers of this library: the attacks on a small page, with and without TLS; limits; errors of handlers."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import socket
import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, override
from unittest.mock import patch

import attrs
import pytest
from aiohttp import web
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)
from ibrobot_http import server as module
from ibrobot_http.addresses import LOCAL, check_name, host_names, is_loopback
from ibrobot_http.certificates import own_certificate
from ibrobot_http.files import add_files
from ibrobot_http.guard import Guard
from ibrobot_http.listener import listen, tls_context
from ibrobot_http.server import ServerThread, _Door
from ibrobot_testing.http import HttpSuite, Served

from ibrobot_core.api import IbrobotError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    (folder / "index.html").write_text("<!doctype html><title>a page</title>")
    (folder / "style.css").write_text("")
    (folder / "py.typed").write_text("")
    own_certificate(folder, LOCAL)
    return folder


@contextmanager
def small_page(folder: Path, *, tls: bool = False, **options: Any) -> Iterator[Served]:
    """A page with roles, a socket and a request that changes something."""
    context = tls_context(folder / "certificate.pem", folder / "key.pem") if tls else None
    guard = Guard(listen("127.0.0.1", 0, LOCAL, tls=context), roles=("drive", "watch"), **options)

    async def echo(request: web.Request) -> web.StreamResponse:
        return web.json_response({"role": guard.role(request), "sent": len(await request.read())})

    async def fail(request: web.Request) -> web.StreamResponse:
        raise ZeroDivisionError("one over nothing")

    async def large(request: web.Request) -> web.StreamResponse:
        return web.Response(body=bytes(50 << 20))

    async def follow(request: web.Request) -> web.StreamResponse:
        socket = web.WebSocketResponse()
        await socket.prepare(request)
        await socket.receive()
        return socket

    app = web.Application(client_max_size=1 << 20)
    add_files(app, folder)
    app.router.add_post("/api/echo", echo)
    app.router.add_get("/api/role", echo)
    app.router.add_get("/fail", fail)
    app.router.add_get("/large", large)
    app.router.add_get("/socket", follow)
    server = ServerThread(guard, app, "page", close_s=0.1)
    with contextlib.closing(server):
        links = tuple(guard.path(role) for role in ("drive", "watch"))
        yield Served(
            guard.listener.url,
            ("/", "/api/role"),
            ("/api/echo",),
            ("/socket",),
            links,
            other_sites_link=options.get("other_sites_link", False),
        )


class TestPage(HttpSuite):
    @pytest.fixture(autouse=True)
    def in_folder(self, folder: Path) -> None:
        self.folder = folder

    @override
    @contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        with patch("ibrobot_http.guard.REQUEST_S", request_s), small_page(self.folder) as served:
            yield served


class TestPageWithTls(TestPage):
    @override
    @contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        page = small_page(self.folder, tls=True, other_sites_link=True)
        with patch("ibrobot_http.guard.REQUEST_S", request_s), page as served:
            yield served


class Client(HttpSuite):
    __test__ = False


CLIENT = Client()


def test_roles_have_links_of_their_own(folder: Path) -> None:
    with small_page(folder) as served:
        for link, role in zip(served.links, (b"drive", b"watch"), strict=True):
            cookie = CLIENT.cookie(attrs.evolve(served, links=(link,)))
            assert role in CLIENT.ask(served, "/api/role", cookie=cookie).body


def test_session_of_another_server_is_refused(folder: Path) -> None:
    with small_page(folder) as one, small_page(folder) as other:
        name = CLIENT.cookie(other).partition("=")[0]
        value = CLIENT.cookie(one).partition("=")[2]
        assert CLIENT.ask(other, "/", cookie=f"{name}={value}").status == 401
        assert one.links[0] != other.links[0]


def test_password_takes_the_place_of_the_first_link(folder: Path) -> None:
    with small_page(folder, password="correct horse battery") as served:
        assert (served.links[0], served.links[1].startswith("/?token=")) == ("/", True)
        answer = CLIENT.ask(served, "/")
        assert (answer.status, b"Password" in answer.body) == (401, True)
        assert "form-action 'self'" in answer.headers["Content-Security-Policy"]
        assert CLIENT.ask(served, "/static/style.css").status == 200


def test_browsers_shall_insist_on_tls_only_if_the_server_says_so(folder: Path) -> None:
    for options, wanted in (({"strict_transport": True}, "max-age=31536000"), ({}, None)):
        with small_page(folder, tls=True, **options) as served:
            assert CLIENT.ask(served, "/").headers["Strict-Transport-Security"] == wanted


def test_session_that_ends_meanwhile_keeps_its_role_for_the_request(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ibrobot_http.guard._SESSIONS", 1)
    with small_page(folder) as served:
        cookie = CLIENT.cookie(served)
        head = f"POST /api/echo HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\nContent-Length: 1\r\n"
        with served.connect(30) as client:
            client.sendall(f"{head}Expect: 100-continue\r\nConnection: close\r\n\r\n".encode())
            assert b"100 Continue" in client.recv(1000)  # the request is about to be admitted
            while CLIENT.ask(served, "/", cookie=cookie).status == 200:
                CLIENT.cookie(served)
            client.sendall(b"x")
            assert b'"role": "drive"' in b"".join(iter(lambda: client.recv(1000), b""))


def test_key_that_others_may_use_is_refused(folder: Path, tmp_path: Path) -> None:
    certificate, key = own_certificate(tmp_path, LOCAL)
    for mode in (0o604, 0o602, 0o601, 0o666):
        key.chmod(mode)
        with pytest.raises(IbrobotError, match=rf"^viewer: every user of this machine may use .*: chmod 600 {key}$"):
            tls_context(certificate, key, of="viewer: ")
    for mode in (0o600, 0o400, 0o640):
        key.chmod(mode)
        tls_context(certificate, key)


def test_files_that_are_no_certificate_and_key_are_named(tmp_path: Path) -> None:
    certificate, key = own_certificate(tmp_path, LOCAL)
    private = load_pem_private_key(key.read_bytes(), None)
    locked, empty, other = (
        tmp_path / "locked.pem",
        tmp_path / "empty.pem",
        own_certificate(tmp_path / "other", LOCAL)[1],
    )
    locked.write_bytes(private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"secret")))
    empty.touch()
    for wrong in (locked, empty, other, certificate, tmp_path / "none.pem", tmp_path, Path("a\0b")):
        with pytest.raises(IbrobotError, match=r"^certificate .*certificate\.pem and key .* cannot be used: "):
            tls_context(certificate, wrong)


def test_names_that_no_browser_sends_are_refused() -> None:
    for name in ("robot.lab", "ROBOT-2", "192.168.1.5", "::1", "localhost"):
        check_name(None, None, name)
    for name in ("", "a\0b", "a\r\nb", "*", "robot.lab.", "robot.lab:80", "https://robot.lab", "1.2.3", "-a", "ä.lab"):
        with pytest.raises(ValueError, match="is not a host name or an address"):
            check_name(None, None, name)


def test_failures_are_logged_and_say_nothing_to_clients(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with small_page(folder) as served:
        answer = CLIENT.ask(served, "/fail", cookie=CLIENT.cookie(served))
        assert (answer.status, answer.body) == (500, b"failed; see the log\n")
    assert "one over nothing" in caplog.text


def test_clients_that_send_garbage_are_not_logged(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    for tls in (False, True):
        with small_page(folder, tls=tls) as served:
            port = int(served.host.rpartition(":")[2])
            for garbage in (
                b"",
                b"\x00" * 100,
                b"GET / HTTP/9.9\r\n\r\n",
                b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\n\r\n",
            ):
                with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
                    client.sendall(garbage)
                    client.shutdown(socket.SHUT_WR)
                    with contextlib.suppress(ConnectionError):
                        client.recv(1000)
            cookie = CLIENT.cookie(served)
            head = f"POST /api/echo HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\nContent-Length: 9\r\n"
            for body in ("\r\n", "Content-Encoding: gzip\r\n\r\nno gzip!!"):
                with served.connect(30) as client:
                    client.sendall(f"{head}{body}".encode())
    assert [record for record in caplog.records if record.exc_info or record.levelno >= logging.WARNING] == []


def test_each_reason_to_refuse_is_logged_once(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    with small_page(folder) as served:
        for host in ("a.example", "b.example"):
            CLIENT.ask(served, "/", [("Host", host)])
    logged = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert [line.partition(": ")[2] for line in logged] == [
        "refused a request: this host name is not served: use the address that the terminal shows"
    ]


def test_without_tls_nothing_is_answered(folder: Path) -> None:
    with small_page(folder, tls=True) as served:
        port = int(served.host.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=30) as plain:
            plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            with contextlib.suppress(ConnectionResetError):
                assert b"HTTP" not in plain.recv(100)


def test_old_tls_is_refused(folder: Path) -> None:
    old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    old.check_hostname, old.verify_mode = False, ssl.CERT_NONE
    old.set_ciphers("ALL:@SECLEVEL=0")  # offers TLS 1.1
    with pytest.warns(DeprecationWarning, match="TLSv1_1"):
        old.minimum_version = old.maximum_version = ssl.TLSVersion.TLSv1_1
    with small_page(folder, tls=True) as served:
        port = int(served.host.rpartition(":")[2])
        with (
            socket.create_connection(("127.0.0.1", port), timeout=30) as plain,
            pytest.raises(ssl.SSLError, match=r"EOF|ALERT"),
        ):
            old.wrap_socket(plain)


def test_handshakes_that_do_not_end_are_ended(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ibrobot_http.guard.REQUEST_S", 0.2)
    with small_page(folder, tls=True) as served:
        port = int(served.host.rpartition(":")[2])
        with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
            client.sendall(b"\x16\x03\x01")
            assert client.recv(1) == b""


def test_client_that_does_not_read_its_answer_is_ended(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, "_ANSWER_S", 0.2)
    caplog.set_level(logging.DEBUG, "ibrobot.http")
    with small_page(folder) as served, served.connect(30) as client:
        cookie = CLIENT.cookie(served)
        client.sendall(f"GET /large HTTP/1.1\r\nHost: {served.host}\r\nCookie: {cookie}\r\n\r\n".encode())
        while "does not read" not in caplog.text:
            assert CLIENT.ask(served, "/", cookie=cookie).status == 200
        received = 0
        with contextlib.suppress(ConnectionError):
            while part := client.recv(1 << 20):
                received += len(part)
        assert received < 50 << 20


def test_connections_beyond_the_limit_are_refused_until_others_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_CLIENTS", 3)
    monkeypatch.setattr("ibrobot_http.guard.REQUEST_S", 3600.0)
    with small_page(folder) as served, contextlib.ExitStack() as crowd:
        for _ in range(3):
            crowd.enter_context(served.connect(30))
        with served.connect(30) as late, contextlib.suppress(ConnectionError):
            assert late.recv(1) == b""
        crowd.close()
        while True:  # the server notices that they have left
            with contextlib.suppress(OSError):
                assert CLIENT.ask(served, "/").status == 401
                break


@pytest.mark.parametrize("tls", [False, True])
def test_connections_that_begin_while_the_server_ends_are_ended(folder: Path, *, tls: bool) -> None:
    with contextlib.ExitStack() as clients:
        with small_page(folder, tls=tls) as served:
            begun = [clients.enter_context(served.reach(30)) for _ in range(5)]
        for client in begun:
            with contextlib.suppress(ConnectionError):
                assert client.recv(1) == b""


def test_port_that_is_taken_is_named() -> None:
    with contextlib.closing(listen("127.0.0.1", 0, LOCAL).socket) as taken:
        port = taken.getsockname()[1]
        why = rf"^page: port {port} of 127\.0\.0\.1 is not available: Address already in use.*: --port 0$"
        with pytest.raises(IbrobotError, match=why):
            listen("127.0.0.1", port, LOCAL, of="page: ", any_port="--port 0")


def test_names_of_a_server() -> None:
    name = socket.gethostname().lower()
    assert host_names("127.0.0.1", ["robot.lab"]) == (*LOCAL, "robot.lab")
    assert host_names("192.168.1.5") == ("192.168.1.5", name, f"{name}.local", *LOCAL)
    assert host_names("0.0.0.0", ["robot.lab"])[:3] == (name, f"{name}.local", "robot.lab")
    assert [is_loopback(host) for host in ("localhost", "::1", "127.9.9.9", "0.0.0.0", "robot.lab")] == [
        True,
        True,
        True,
        False,
        False,
    ]


def test_addresses_of_ipv6_stand_in_brackets() -> None:
    listener = listen("127.0.0.1", 0, ("fe80::1",))
    with contextlib.closing(listener.socket):
        assert listener.url == f"http://[fe80::1]:{listener.port}"


def test_one_connection_is_accepted_when_no_file_can_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    opened = socket.create_server(("127.0.0.1", 0))
    address = opened.getsockname()
    door = _Door(opened)
    accept, devnull = socket.socket.accept, os.open
    spares = door._spare

    def short_of_files(self: socket.socket) -> tuple[socket.socket, Any]:
        if spares:
            raise OSError(errno.EMFILE, "Too many open files")
        return accept(self)

    def refuse(*arguments: Any) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(socket.socket, "accept", short_of_files)
    monkeypatch.setattr(os, "open", refuse)
    with socket.create_connection(address):
        accepted, _ = door.accept()
        accepted.close()
    assert not spares
    monkeypatch.setattr(os, "open", devnull)
    monkeypatch.setattr(socket.socket, "accept", accept)
    with socket.create_connection(address):
        door.accept()[0].close()
    assert spares, "it is kept again"
    door.end_all()
    door.close()
    assert not spares
