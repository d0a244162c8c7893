"""The page's own certificate, and what `ibrobot doctor` says about it."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import segno
from ibrobot_webxr import certificate as certificates
from ibrobot_webxr.certificate import expiry, own_certificate, tls_context
from ibrobot_webxr.doctor import checks
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.qr import qr_code

from ibrobot_core.api import TeleopError

NAMES = ("robot.lab", "192.168.1.5", "localhost")


def test_a_certificate_is_made_once_and_again_for_other_names(tmp_path: Path):
    certificate, key = own_certificate(tmp_path / "own", NAMES)
    assert key.stat().st_mode & 0o777 == 0o600
    assert (tmp_path / "own").stat().st_mode & 0o777 == 0o700
    first = certificate.read_bytes()
    own_certificate(tmp_path / "own", NAMES[1:])
    assert certificate.read_bytes() == first
    own_certificate(tmp_path / "own", (*NAMES, "other.lab"))
    assert certificate.read_bytes() != first
    assert timedelta(days=300) < expiry(certificate) - datetime.now(UTC) < timedelta(days=398)


def test_a_certificate_is_replaced_before_it_expires(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(certificates, "_DAYS", 20)
    certificate, _ = own_certificate(tmp_path, NAMES)
    first = certificate.read_bytes()
    monkeypatch.setattr(certificates, "_DAYS", 365)
    own_certificate(tmp_path, NAMES)
    assert certificate.read_bytes() != first


def test_a_browser_that_trusts_the_certificate_accepts_its_names(tmp_path: Path):
    certificate, _ = own_certificate(tmp_path, ("localhost",))
    server = tls_context(WebxrOptions(), tmp_path)
    client = ssl.create_default_context(cafile=str(certificate))
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    asks = client.wrap_bio(to_client, to_server, server_hostname="localhost")
    answers = server.wrap_bio(to_server, to_client, server_side=True)
    done = set()
    for _ in range(4):
        for side in (asks, answers):
            try:
                side.do_handshake()
                done.add(side)
            except ssl.SSLWantReadError:
                pass
    assert done == {asks, answers}


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(TeleopError, match=r"file.*: (Not a directory|File exists)"):
        tls_context(WebxrOptions(), tmp_path / "file")


def test_doctor_checks_the_certificate_and_its_key(tmp_path: Path):
    (check,) = checks(tmp_path)
    assert check.ok
    assert "none yet" in check.found
    certificate, key = own_certificate(tmp_path, NAMES)
    assert [check.ok for check in checks(tmp_path)] == [True, True]
    key.chmod(0o644)
    found = list(checks(tmp_path))
    assert (found[1].ok, found[1].remedy) == (False, f"chmod 600 {key}")
    certificate.write_text("?")
    (check,) = checks(tmp_path)
    assert not check.ok
    assert check.remedy.startswith(f"remove {tmp_path}")


def test_the_qr_code_has_the_modules_of_its_text():
    text = "https://192.168.1.5:8443/?token=0123456789abcdef"
    lines = qr_code(text).splitlines()
    modules = [list(row) for row in segno.make(text, error="l").matrix_iter(border=2)]
    assert len({len(line) for line in lines}) == 1
    for i, row in enumerate(modules):
        for j, dark in enumerate(row):
            light = lines[i // 2][j] in ("█▀" if i % 2 == 0 else "█▄")
            assert light != bool(dark)
