"""Certificates for a lab: a private authority, and a certificate and key for each machine."""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ibrobot_core.api import TransportError
from ibrobot_zenoh.access import read_lines
from ibrobot_zenoh.identity import Identity, Role, identity_in, subject

CA, CA_KEY = "ca.pem", "ca.key"
CERTIFICATE, KEY = "certificate.pem", "key.pem"
ROBOTS = "robots.txt"
"""The list of admitted robots: the authority's own, and a copy in each server's folder."""

_EARLY = timedelta(days=2)
"""Certificates are valid from a time before their creation, for machines whose clock is behind."""


class Authority:
    """A certificate authority: its certificate and key in a folder, which are created if they do not exist.

    Args:
        folder: the folder with `ca.pem` and `ca.key`.
        days: validity of new certificates [days].

    Raises:
        TransportError: if only one of the two exists, they cannot be read, or the authority has expired.
    """

    def __init__(self, folder: Path, days: int) -> None:
        self._folder = folder
        self._days = days
        certificate, key = folder / CA, folder / CA_KEY
        self.is_new = not certificate.exists() and not key.exists()
        if self.is_new:
            self._key = ec.generate_private_key(ec.SECP256R1())
            self._certificate = self._make()
            folder.mkdir(parents=True, exist_ok=True)
            _write_key(key, self._key)
            _write(certificate, self._certificate)
            return
        try:
            self._certificate = x509.load_pem_x509_certificate(certificate.read_bytes())
            loaded = load_pem_private_key(key.read_bytes(), password=None)
        except (OSError, ValueError) as error:
            raise TransportError(f"{folder}: its {CA} and {CA_KEY} cannot be read: {error}") from error
        if not isinstance(loaded, ec.EllipticCurvePrivateKey) or loaded.public_key() != self._certificate.public_key():
            raise TransportError(f"{key}: is not the key of {certificate}")
        self._key = loaded
        end = self._certificate.not_valid_after_utc
        if end < datetime.now(UTC):
            raise TransportError(f"{certificate}: expired on {end:%Y-%m-%d}; make new certificates in another folder")

    @property
    def ends(self) -> datetime:
        """The expiry of new certificates, not later than the authority's."""
        return min(self._certificate.not_valid_after_utc, datetime.now(UTC) + timedelta(days=self._days))

    def issue(self, name: str, hosts: Sequence[str] = ()) -> Path:
        """Make a folder `name` with `ca.pem`, `certificate.pem` and `key.pem`.

        Args:
            name: the certificate's common name, which identifies the machine in access lists.
            hosts: names and addresses of a server; none for a robot, which only connects.

        Raises:
            TransportError: if the folder exists.
        """
        folder = self._folder / name
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise TransportError(f"{folder} exists already; nothing is overwritten") from None
        key = ec.generate_private_key(ec.SECP256R1())
        names = x509.SubjectAlternativeName([_general_name(host) for host in hosts or (name,)])
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        certificate = (
            self._builder(subject(Identity(name, Role.SERVER if hosts else Role.ROBOT)), key)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(names, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        _write_key(folder / KEY, key)
        _write(folder / CERTIFICATE, certificate)
        _write(folder / CA, self._certificate)
        return folder

    def admit(self, robots: Sequence[str]) -> list[Path]:
        """Add names to the list of robots, and copy it to all servers' folders; returns those copies.

        Raises:
            TransportError: if the list cannot be read.
        """
        own = self._folder / ROBOTS
        names = [*(read_lines(own) if own.exists() else ()), *robots]
        copies = sorted(
            folder / ROBOTS
            for folder in self._folder.iterdir()
            if (folder / CERTIFICATE).exists() and _is_server(folder / CERTIFICATE)
        )
        for path in (own, *copies):
            path.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        return copies

    def _make(self) -> x509.Certificate:
        usage = {
            name: name in ("key_cert_sign", "crl_sign")
            for name in (
                "digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
                "key_cert_sign", "crl_sign", "encipher_only", "decipher_only",
            )
        }  # fmt: skip
        return (
            self._builder(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ibrobot authority")]), self._key)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.KeyUsage(**usage), critical=True)
            .sign(self._key, hashes.SHA256())
        )

    def _builder(self, name: x509.Name, key: ec.EllipticCurvePrivateKey) -> x509.CertificateBuilder:
        now = datetime.now(UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(name)
            .issuer_name(name if key is self._key else self._certificate.subject)
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - _EARLY)
            .not_valid_after(now + timedelta(days=self._days) if key is self._key else self.ends)
        )


def _is_server(certificate: Path) -> bool:
    return identity_in(certificate).role is Role.SERVER


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write(path: Path, certificate: x509.Certificate) -> None:
    with open(path, "xb") as file:
        file.write(certificate.public_bytes(Encoding.PEM))


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a key, readable only by its owner from the beginning."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
