"""`ibrobot certs`: what it makes, what it refuses, and that nobody gets anything without it."""

from __future__ import annotations

import json
import queue
import socket
import ssl
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import attrs
import pytest
import yaml
import zenoh
from click.testing import CliRunner, Result
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID
from ibrobot_testing import make_session
from ibrobot_testing.command import command_line
from ibrobot_zenoh.certificates import Authority
from ibrobot_zenoh.options import Tls
from ibrobot_zenoh.panel import peer_rows
from ibrobot_zenoh.reasons import why_not

from ibrobot_core.api import Int32, String, TransportError
from ibrobot_core.app import RequestError

from .pair import WAIT_S, client, free_endpoint, router, settle, wait_for

certs = command_line("certs")


def run(*arguments: Any) -> Result:
    return CliRunner().invoke(certs, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab") / "certificates"
    result = run(folder, "--server", "localhost,127.0.0.1", "--robot", "robot1", "--robot", "robot2")
    assert result.exit_code == 0, result.output
    return folder


def tls(folder: Path, name: str) -> Tls:
    robots = folder / name / "robots.txt"
    ca, certificate, key = (folder / name / file for file in ("ca.pem", "certificate.pem", "key.pem"))
    return Tls(ca, certificate, key, robots if robots.exists() else None)


def test_requests_pass_with_certificates(lab: Path):
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=tls(lab, "localhost"))
    server.serve("echo", lambda payload, _: payload)
    robots = [client(endpoint, tls=tls(lab, name)) for name in ("robot1", "robot2")]
    for robot, name in zip(robots, ("robot1", "robot2"), strict=True):
        settle(robot, server, name)
        assert robot.request("echo", b"hello", WAIT_S) == b"hello"
    peers = peer_rows(make_session())
    assert sorted((kind, name) for _, kind, _, name in peers if kind == "client") == [
        ("client", "robot1"),
        ("client", "robot2"),
    ]
    assert {address for _, kind, address, _ in peers if kind == "router"} == {endpoint}
    for end in (*robots, server):
        end.close()
    assert peer_rows(make_session()) == []


def test_another_authority_s_certificate_gets_nothing(lab: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    assert run(tmp_path / "other", "--server", "localhost,127.0.0.1", "--robot", "robot1").exit_code == 0
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=tls(lab, "localhost"))
    server.serve("echo", lambda payload, _: payload)
    # One that trusts the server, so that it is the server that refuses; and one that does not.
    stranger = Tls(lab / "ca.pem", tmp_path / "other/robot1/certificate.pem", tmp_path / "other/robot1/key.pem")
    stranger_s = tls(tmp_path / "other", "robot1")
    for wrong, said in (
        (stranger, f"it refuses {stranger.certificate}"),
        (stranger_s, f"not signed by {stranger_s.ca}"),
    ):
        caplog.clear()
        robot = client(endpoint, tls=wrong)
        wait_for(lambda: "not connected" in caplog.text)
        with pytest.raises(TransportError, match=rf"not connected: {endpoint}: .*{said}"):
            robot.request("echo", b"hello", 1.0)
        robot.close()
    server.close()


def test_a_connection_without_a_certificate_gets_nothing(lab: Path):
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=tls(lab, "localhost"))
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 0,
        "scouting/multicast/enabled": False,
        "transport/link/tls/root_ca_certificate": str(lab / "ca.pem"),
    }.items():
        config.insert_json5(key, json.dumps(value))
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        zenoh.open(config).close()
    server.close()


def test_a_server_of_another_name_is_not_believed(lab: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    assert run(lab, "--server", "elsewhere.lab").exit_code == 0
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=tls(lab, "elsewhere.lab"))
    robot = client(endpoint, tls=tls(lab, "robot1"))
    wait_for(lambda: "certificate is not valid for '127.0.0.1'" in caplog.text)
    robot.close()
    server.close()


def test_a_robot_s_certificate_is_not_a_server_s(lab: Path):
    """A machine does not listen with it; and one that does so by other means is not believed."""
    with pytest.raises(TransportError, match="is the certificate of robot robot2, which may only connect"):
        router(free_endpoint("tls"), tls=tls(lab, "robot2"))
    with _pretends_to_be_a_server(tls(lab, "robot2")) as endpoint:
        assert "made for a --robot" in why_not(endpoint, tls(lab, "robot1"))


@contextmanager
def _pretends_to_be_a_server(files: Tls) -> Iterator[str]:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(files.certificate, files.key)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def greet() -> None:
            with suppress(OSError), listening.accept()[0] as stream:
                context.wrap_socket(stream, server_side=True).close()

        thread = threading.Thread(target=greet)
        thread.start()
        yield f"tls/127.0.0.1:{listening.getsockname()[1]}"
        thread.join()


def test_a_server_needs_a_list_of_robots(lab: Path, tmp_path: Path):
    files = tls(lab, "localhost")
    with pytest.raises(TransportError, match=r"no robot is admitted: set tls\.robots"):
        router(free_endpoint("tls"), tls=attrs.evolve(files, robots=None))
    robots = tmp_path / "robots.txt"
    for text, said in (("robot1\n\n../up\n", "3: '../up' cannot be"), ("robot1\nrobot1 # again\n", "2: 'robot1' is")):
        robots.write_text(text)
        with pytest.raises(TransportError, match=f"robots.txt:{said}"):
            router(free_endpoint("tls"), tls=attrs.evolve(files, robots=robots))
    with pytest.raises(TransportError, match=r"none.txt: cannot be read"):
        router(free_endpoint("tls"), tls=attrs.evolve(files, robots=tmp_path / "none.txt"))


def test_a_robot_that_is_not_listed_gets_nothing(lab: Path, tmp_path: Path):
    """Its certificate is valid, but its name was removed from the access list. The error names both possible causes."""
    robots = tmp_path / "robots.txt"
    robots.write_text("# robot1 is in repair\nrobot2\n")
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=attrs.evolve(tls(lab, "localhost"), robots=robots))
    server.serve("echo", lambda payload, _: payload)
    listed, struck = (client(endpoint, tls=tls(lab, name)) for name in ("robot2", "robot1"))
    settle(listed, server, "robot2")
    assert listed.request("echo", b"x", WAIT_S) == b"x"
    with pytest.raises(TransportError, match=r"nobody serves echo, .*its list of robots lacks 'robot1'"):
        struck.request("echo", b"x", WAIT_S)
    for end in (listed, struck, server):
        end.close()


def test_a_certificate_without_a_role_is_refused(lab: Path, tmp_path: Path):
    """As `ibrobot certs` made them before: the remedy is in the error."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "robot1")])
    now = datetime.now(UTC)
    old = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now)
        .not_valid_after(now + timedelta(days=1))
        .sign(key, hashes.SHA256())
    )
    (tmp_path / "certificate.pem").write_bytes(old.public_bytes(Encoding.PEM))
    private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (tmp_path / "key.pem").write_bytes(private)
    without_role = Tls(lab / "ca.pem", tmp_path / "certificate.pem", tmp_path / "key.pem")
    for make in (client, router):
        with pytest.raises(TransportError, match=r"certificate\.pem: has no role .*ibrobot certs NEW_FOLDER"):
            make(free_endpoint("tls"), tls=without_role)


def test_topics_go_under_the_name_in_the_certificate(lab: Path):
    """Without a namespace; under another one it is an error here, since the server would drop it in silence."""
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=tls(lab, "localhost"))
    robot, other = client(endpoint, tls=tls(lab, "robot1")), client(endpoint, tls=tls(lab, "robot2"), namespace="")
    robot.publish_message("/name", String("robot1"), latched=True)
    for hears in (server, other):
        arrived: queue.SimpleQueue[object] = queue.SimpleQueue()
        hears.subscribe_messages("/robot1/name", arrived.put)
        assert arrived.get(timeout=WAIT_S) == String("robot1")
    for topic in ("/robot1/name", "/name"):
        with pytest.raises(TransportError, match=f"{topic}: robot2 may publish only below /robot2"):
            other.publish_message(topic, String("robot2"))
    with pytest.raises(TransportError, match="robot2 may publish only below /robot2"):
        other.publish("robot1/state", b"")
    for end in (robot, other, server):
        end.close()


def test_the_server_s_own_certificate_may_do_everything(lab: Path):
    """For `ibrobot topic` beside the server."""
    endpoint = free_endpoint("tls")
    server, beside = router(endpoint, tls=tls(lab, "localhost")), client(endpoint, tls=tls(lab, "localhost"))
    robot = client(endpoint, tls=tls(lab, "robot1"))
    arrived: queue.SimpleQueue[object] = queue.SimpleQueue()
    robot.subscribe_messages("/lamp", arrived.put)
    wait_for(lambda: beside.publish_message("/robot1/lamp", Int32(1)) or not arrived.empty())
    assert arrived.get(timeout=WAIT_S) == Int32(1)
    for end in (beside, robot, server):
        end.close()


@pytest.mark.usefixtures("brief_trials")
def test_a_server_without_tls_is_reported(lab: Path):
    plain = free_endpoint("tcp")
    server = router(plain)
    assert "does not speak TLS" in why_not(plain.replace("tcp", "tls"), tls(lab, "robot1"))
    server.close()


def test_a_client_without_tls_is_reported(lab: Path):
    secured = free_endpoint("tls")
    server = router(secured, tls=tls(lab, "localhost"))
    assert "write tls/ for tcp/" in why_not(secured.replace("tls", "tcp"), None)
    server.close()


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("tcp/nowhere.invalid:7447", "no machine of the name 'nowhere.invalid'"),
        ("tcp/[::1]:1", "nobody listens there"),
        ("quic/127.0.0.1:1", "there is no answer"),
    ],
)
def test_what_is_not_there_is_reported(endpoint: str, said: str):
    assert said in why_not(endpoint, None)


@pytest.mark.parametrize(
    ("ca", "certificate", "key", "said"),
    [
        ("robot1/ca.pem", "robot1/certificate.pem", "robot2/key.pem", "robot2/key.pem: is not the key of"),
        ("ca.key", "robot1/certificate.pem", "robot1/key.pem", "ca.key: is not a certificate in PEM"),
        ("ca.pem", "robot1/certificate.pem", "ca.pem", "are not a certificate and key in PEM"),
        ("ca.pem", "nobody/certificate.pem", "robot1/key.pem", "nobody/certificate.pem: cannot be read: No such file"),
    ],
)
@pytest.mark.parametrize("mode", ["client", "router"])
def test_files_that_do_not_belong_together_are_reported(
    lab: Path, ca: str, certificate: str, key: str, said: str, mode: str
):
    endpoint = free_endpoint("tls")
    make = client if mode == "client" else router
    with pytest.raises(TransportError, match=said):
        make(endpoint, tls=Tls(lab / ca, lab / certificate, lab / key))


def test_the_readme_s_access_control(lab: Path, tmp_path: Path):
    """The user's own list takes the place of ours, and needs no list of robots."""
    readme = Path(__file__).parents[1].joinpath("README.md").read_text(encoding="utf-8")
    settings = tmp_path / "access.json5"
    settings.write_text(readme.partition("```json5\n")[2].partition("```")[0])
    endpoint = free_endpoint("tls")
    server = router(endpoint, tls=attrs.evolve(tls(lab, "localhost"), robots=None), settings=settings)
    server.serve("infer/net", lambda payload, sender: f"{sender}".encode())
    server.serve("secret", lambda payload, _: payload)
    first, second = (client(endpoint, tls=tls(lab, name)) for name in ("robot1", "robot2"))
    for robot in (first, second):
        states: queue.SimpleQueue[bool] = queue.SimpleQueue()
        robot.watch("infer/net", states.put)
        while not states.get(timeout=WAIT_S):
            pass
        with pytest.raises(TransportError, match="nobody serves secret"):
            robot.request("secret", b"x", WAIT_S)
    assert first.request("infer/net", b"x", WAIT_S) == b"None"  # who asks is not proved by another robot's list
    for end in (first, second, server):
        end.close()


def test_what_is_made(lab: Path):
    for key in (lab / "ca.key", lab / "localhost/key.pem", lab / "robot1/key.pem"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
    server = x509.load_pem_x509_certificate((lab / "localhost/certificate.pem").read_bytes())
    names = server.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["localhost"]
    assert [str(address) for address in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1"]
    robot = x509.load_pem_x509_certificate((lab / "robot1/certificate.pem").read_bytes())
    assert robot.subject.rfc4514_string() == "OU=robot,CN=robot1"
    assert server.subject.rfc4514_string() == "OU=server,CN=localhost"
    assert (lab / "localhost/robots.txt").read_text().splitlines()[:2] == ["robot1", "robot2"]
    usages = robot.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert [usage._name for usage in usages] == ["clientAuth"]  # it cannot pretend to be the server
    authority = x509.load_pem_x509_certificate((lab / "ca.pem").read_bytes())
    for made in (server, robot):
        made.verify_directly_issued_by(authority)


def test_the_yaml_to_paste(tmp_path: Path):
    result = run(tmp_path / "lab", "--server", "gpu.lab,192.168.1.5", "--robot", "arm")
    server, robot = (yaml.safe_load(part.partition("\n")[2]) for part in result.output.split("\n# ")[1:])
    files = {"ca": "ca.pem", "certificate": "certificate.pem", "key": "key.pem"}
    assert server["transport"] == {
        "type": "zenoh",
        "mode": "router",
        "listen": ["tls/0.0.0.0:7447"],
        "tls": {key: f"gpu.lab/{file}" for key, file in {**files, "robots": "robots.txt"}.items()},
    }
    assert robot["transport"] == {
        "type": "zenoh",
        "connect": ["tls/gpu.lab:7447"],
        "tls": {key: f"arm/{file}" for key, file in files.items()},
    }


def test_an_ipv6_address_is_put_in_brackets(tmp_path: Path):
    output = run(tmp_path / "lab", "--server", "fe80::1,gpu.lab", "--robot", "robot1").output
    assert yaml.safe_load(output.partition("# robot1")[2].partition("\n")[2])["transport"]["connect"] == [
        "tls/[fe80::1]:7447"
    ]


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(TransportError, match=r"file/lab: cannot be written: Not a directory"):
        certs.main([str(tmp_path / "file/lab"), "--robot", "robot1"], standalone_mode=False)


def test_the_same_authority_signs_what_comes_later(lab: Path):
    before = (lab / "ca.pem").read_bytes()
    output = run(lab, "--robot", "robot9").output
    assert "signed by the authority" in output
    assert f"# localhost: copy {lab}/localhost/robots.txt there again" in output
    assert "robot9" in (lab / "localhost/robots.txt").read_text().splitlines()
    assert (lab / "ca.pem").read_bytes() == (lab / "robot9/ca.pem").read_bytes() == before


def test_nothing_is_valid_for_longer_than_its_authority(tmp_path: Path):
    first = run(tmp_path, "--robot", "robot1", "--days", "10")
    later = run(tmp_path, "--robot", "robot2", "--days", "100")
    ends = [each.output.partition("all is valid until ")[2][:10] for each in (first, later)]
    assert ends[0] == ends[1] == f"{datetime.now(UTC) + timedelta(days=10):%Y-%m-%d}"
    made = [
        x509.load_pem_x509_certificate((tmp_path / name).read_bytes()) for name in ("ca.pem", "robot2/certificate.pem")
    ]
    assert made[0].not_valid_after_utc == made[1].not_valid_after_utc


def test_an_authority_that_has_expired_signs_nothing(tmp_path: Path):
    Authority(tmp_path, days=-1)
    with pytest.raises(TransportError, match=r"ca\.pem: expired on 20\d\d-\d\d-\d\d; make new"):
        Authority(tmp_path, days=10)


def test_nothing_is_overwritten(lab: Path):
    before = {path: path.read_bytes() for path in lab.rglob("*.pem")}
    result = run(lab, "--robot", "new", "--robot", "robot1")
    assert isinstance(result.exception, TransportError)
    assert "robot1 exists already" in str(result.exception)
    assert {path: path.read_bytes() for path in lab.rglob("*.pem")} == before


@pytest.mark.parametrize("damage", ["missing", "garbage", "another"])
def test_an_authority_that_cannot_sign_is_refused(damage: str, tmp_path: Path):
    assert run(tmp_path, "--robot", "robot1").exit_code == 0
    key = tmp_path / "ca.key"
    if damage == "missing":
        key.unlink()
    elif damage == "garbage":
        key.write_text("no key")
    else:
        key.write_bytes((tmp_path / "robot1/key.pem").read_bytes())
    result = run(tmp_path, "--robot", "robot2")
    assert isinstance(result.exception, TransportError)
    assert "ca.key" in str(result.exception)
    assert not (tmp_path / "robot2").exists()


@pytest.mark.parametrize(
    "arguments",
    [(), ("--robot", "../up"), ("--robot", "robot-1"), ("--server", "a b"), ("--robot", ""), ("--server", ",")],
)
def test_wrong_arguments(arguments: tuple[str, ...], tmp_path: Path):
    assert isinstance(run(tmp_path / "lab", *arguments).exception, RequestError)
    assert not (tmp_path / "lab").exists()
