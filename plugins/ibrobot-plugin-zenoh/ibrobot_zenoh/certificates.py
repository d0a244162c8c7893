"""Certificates for a lab: a private authority, and a certificate and key for each machine."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID
from ibrobot_http.certificates import (
    CERTIFICATE,
    KEY,
    Issuer,
    common_name,
    make_certificate,
    make_key,
    write_certificate,
    write_key,
)

from ibrobot_core.api import TransportError
from ibrobot_zenoh.access import read_lines
from ibrobot_zenoh.identity import Identity, Role, identity_in, subject

CA, CA_KEY = "ca.pem", "ca.key"
ROBOTS = "robots.txt"
"""The list of admitted robots: the authority's own, and a copy in each server's folder."""


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
            self._key = make_key()
            own = Issuer(common_name("ibrobot authority"), self._key)
            ends = datetime.now(UTC) + timedelta(days=days)
            self._certificate = make_certificate(own.name, own.key, own, ends, authority=True)
            folder.mkdir(parents=True, exist_ok=True)
            write_key(key, self._key)
            write_certificate(certificate, self._certificate)
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
        key = make_key()
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
        owner = subject(Identity(name, Role.SERVER if hosts else Role.ROBOT))
        issuer = Issuer(self._certificate.subject, self._key)
        certificate = make_certificate(owner, key, issuer, self.ends, hosts=hosts or (name,), usages=usages)
        write_key(folder / KEY, key)
        write_certificate(folder / CERTIFICATE, certificate)
        write_certificate(folder / CA, self._certificate)
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


def _is_server(certificate: Path) -> bool:
    return identity_in(certificate).role is Role.SERVER
