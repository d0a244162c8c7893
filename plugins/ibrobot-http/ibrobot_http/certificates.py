"""Certificates: make and write them, and the self-signed one of an installation."""

from __future__ import annotations

import ipaddress
import os
import socket
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import attrs
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

CERTIFICATE, KEY = "certificate.pem", "key.pem"
_DAYS = 365
"""Phones refuse certificates that are valid for more than 398 days."""
_RENEW = timedelta(days=30)
"""A certificate is replaced this long before it expires."""
_EARLY = timedelta(days=2)
"""Certificates are valid from a while before their creation, for machines whose clock is behind."""


@attrs.frozen
class Issuer:
    """Signer of a certificate: an authority, or the subject itself."""

    name: x509.Name
    key: ec.EllipticCurvePrivateKey


def make_key() -> ec.EllipticCurvePrivateKey:
    """A new private key."""
    return ec.generate_private_key(ec.SECP256R1())


def common_name(name: str) -> x509.Name:
    """A subject with only a common name."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def general_name(host: str) -> x509.GeneralName:
    """A host name or address as an alternative name of a certificate."""
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def make_certificate(
    subject: x509.Name, key: ec.EllipticCurvePrivateKey, issuer: Issuer, ends: datetime, *,
    authority: bool = False, hosts: Sequence[str] = (), usages: Sequence[x509.ObjectIdentifier] = (),
) -> x509.Certificate:  # fmt: skip
    """Make and sign a certificate.

    Args:
        subject: the owner.
        key: the subject's key.
        issuer: the signer.
        ends: expiry.
        authority: whether it may sign other certificates.
        hosts: names and addresses of the machine.
        usages: permitted extended usages; any if empty.
    """
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer.name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.now(UTC) - _EARLY)
        .not_valid_after(ends)
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
    )
    if authority:
        builder = builder.add_extension(_signs(serves=bool(usages)), critical=True)
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName(list(map(general_name, hosts))), critical=False)
    if usages:
        builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
    return builder.sign(issuer.key, hashes.SHA256())


def _signs(*, serves: bool) -> x509.KeyUsage:
    """The usage of an authority's key, which may be that of a server, too."""
    return x509.KeyUsage(
        digital_signature=serves, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
    )  # fmt: skip


def write_certificate(path: Path, certificate: x509.Certificate) -> None:
    """Write a new file.

    Raises:
        OSError: if it exists or cannot be written.
    """
    with open(path, "xb") as file:
        file.write(certificate.public_bytes(Encoding.PEM))


def write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    """Write a new file that only its owner can read, from the beginning.

    Raises:
        OSError: if it exists or cannot be written.
    """
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))


def own_certificate(folder: Path, names: Sequence[str]) -> tuple[Path, Path]:
    """The certificate and key in a folder, made if they are missing, expire soon, or are for other names.

    The certificate signs itself. It is an authority, so that phones can install it.

    Raises:
        OSError: if they cannot be written.
    """
    certificate, key = folder / CERTIFICATE, folder / KEY
    if not (key.exists() and _is_usable(certificate, names)):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        certificate.unlink(missing_ok=True)
        key.unlink(missing_ok=True)
        own = Issuer(common_name(f"ibrobot on {socket.gethostname()}"[:64]), make_key())
        ends = datetime.now(UTC) + timedelta(days=_DAYS)
        usages = [ExtendedKeyUsageOID.SERVER_AUTH]
        made = make_certificate(own.name, own.key, own, ends, authority=True, hosts=names, usages=usages)
        write_key(key, own.key)
        write_certificate(certificate, made)
    return certificate, key


def expiry(certificate: Path) -> datetime:
    """When a certificate expires.

    Raises:
        OSError, ValueError: if it cannot be read.
    """
    return x509.load_pem_x509_certificate(certificate.read_bytes()).not_valid_after_utc


def _is_usable(certificate: Path, names: Sequence[str]) -> bool:
    try:
        loaded = x509.load_pem_x509_certificate(certificate.read_bytes())
        listed = loaded.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (OSError, ValueError, x509.ExtensionNotFound):
        return False
    return set(map(general_name, names)) <= set(listed) and loaded.not_valid_after_utc > datetime.now(UTC) + _RENEW
