"""An installation's own certificate."""

from __future__ import annotations

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from ibrobot_http import certificates
from ibrobot_http.certificates import expiry, own_certificate
from ibrobot_http.listener import tls_context

from ibrobot_core.api import IbrobotError

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
    certificate, key = own_certificate(tmp_path, ("localhost",))
    server = tls_context(certificate, key)
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


def test_files_that_are_no_certificate_and_key_are_named(tmp_path: Path):
    certificate, key = own_certificate(tmp_path, NAMES)
    for pair in ((key, key), (certificate, certificate), (certificate, tmp_path / "none.pem")):
        with pytest.raises(IbrobotError, match=rf"^page: certificate {pair[0]} and key {pair[1]} cannot be used: "):
            tls_context(*pair, of="page: ")
