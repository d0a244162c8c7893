"""The certificate of the page: the one in the options, or one of this installation's own."""

from __future__ import annotations

import ipaddress
import os
import socket
import ssl
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ibrobot_core.api import TeleopError
from ibrobot_webxr.options import WebxrOptions, is_loopback

LOCAL = ("localhost", "127.0.0.1")
CERTIFICATE, KEY = "certificate.pem", "key.pem"
_DAYS = 365
"""Phones refuse certificates that are valid for more than 398 days."""
_RENEW = timedelta(days=30)
"""A certificate is replaced this long before it expires."""
_EARLY = timedelta(days=2)
"""A certificate is valid from a time before its creation, for phones whose clock is behind."""


def own_folder() -> Path:
    """The folder of this installation's own certificate: `$XDG_CONFIG_HOME/ibrobot/webxr`, or that in `~/.config`."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return home / "ibrobot" / "webxr"


def server_names(options: WebxrOptions) -> tuple[str, ...]:
    """Names and addresses under which browsers may reach the page; the first is that of the printed address."""
    if is_loopback(options.host):
        return tuple(dict.fromkeys((*options.names, *LOCAL)))
    if options.names:
        return tuple(dict.fromkeys((*options.names, *LOCAL)))
    own = [options.host] if not ipaddress.ip_address(options.host).is_unspecified else _own_addresses()
    return tuple(dict.fromkeys((*own, socket.gethostname().lower(), *LOCAL)))


def _own_addresses() -> list[str]:
    """The address from which this machine reaches other networks, if it has one; sends nothing."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # an address for documentation, RFC 5737
        except OSError:
            return []
        return [str(probe.getsockname()[0])]


def tls_context(options: WebxrOptions, folder: Path | None = None) -> ssl.SSLContext:
    """The server's TLS settings.

    Args:
        options: with the certificate and key, if it is not the own one.
        folder: where the own certificate is kept; None: `own_folder()`.

    Raises:
        TeleopError: if the certificate or key cannot be read, or the own ones cannot be written.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        if options.certificate is not None and options.key is not None:
            certificate, key = options.certificate, options.key
        else:
            certificate, key = own_certificate(own_folder() if folder is None else folder, server_names(options))
        context.load_cert_chain(certificate, key)
    except ssl.SSLError as error:
        raise TeleopError(f"{certificate} and {key} are not a certificate and its key: {error.reason}") from error
    except OSError as error:
        raise TeleopError(f"{error.filename or folder}: {error.strerror}") from error
    return context


def own_certificate(folder: Path, names: Sequence[str]) -> tuple[Path, Path]:
    """The certificate and key in a folder, made if they are missing, expire soon, or are for other names.

    Raises:
        OSError: if they cannot be written.
    """
    certificate, key = folder / CERTIFICATE, folder / KEY
    if not (key.exists() and _is_usable(certificate, names)):
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        _make(certificate, key, names)
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
    return set(map(_general_name, names)) <= set(listed) and loaded.not_valid_after_utc > datetime.now(UTC) + _RENEW


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _make(certificate: Path, key: Path, names: Sequence[str]) -> None:
    private = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"ibrobot on {socket.gethostname()}"[:64])])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(private.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _EARLY)
        .not_valid_after(now + timedelta(days=_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)  # so that phones can install it
        .add_extension(x509.SubjectAlternativeName(list(map(_general_name, names))), critical=False)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(private, hashes.SHA256())
    )
    key.unlink(missing_ok=True)
    with os.fdopen(os.open(key, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(private.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    certificate.write_bytes(made.public_bytes(Encoding.PEM))
