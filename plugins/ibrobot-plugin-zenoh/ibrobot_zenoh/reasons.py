"""Diagnoses failed connections: Zenoh reports no reason, so each step is tried separately."""

from __future__ import annotations

import socket
import ssl

from ibrobot_core.api import TransportError
from ibrobot_zenoh.options import Tls

_TIMEOUT_S = 0.5
"""How long each step waits for the other side [s]."""
_OTHER_AUTHORITY = (7, 18, 19, 20, 21)
"""OpenSSL's error numbers of certificates; 7: an authority with the same name but another key."""
_NAMES = "; `ibrobot certs --server` takes every name and address under which it is reached"
_HINTS = {
    9: "; is the clock here right?",
    10: "; or is the clock here wrong?",
    26: "; it was made for a --robot, which cannot be connected to",
    62: _NAMES,
    64: _NAMES,
}


def tls_context(tls: Tls) -> ssl.SSLContext:
    """The TLS context with which a client presents its certificate and checks the server's.

    Raises:
        TransportError: if a file cannot be read or lacks a certificate or key, or the key is of another certificate.
    """
    for path in (tls.ca, tls.certificate, tls.key):
        try:
            path.open("rb").close()
        except OSError as error:
            raise TransportError(f"{path}: cannot be read: {error.strerror}") from error
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        context.load_verify_locations(tls.ca)
    except ssl.SSLError as error:
        raise TransportError(f"{tls.ca}: is not a certificate in PEM format") from error
    try:
        context.load_cert_chain(tls.certificate, tls.key, password="")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            raise TransportError(f"{tls.key}: is not the key of {tls.certificate}") from error
        raise TransportError(f"{tls.certificate} and {tls.key}: are not a certificate and key in PEM format") from error
    return context


def why_not(endpoint: str, tls: Tls | None) -> str:
    """Why there is no connection to an endpoint, such as `tls/gpu.lab:7447`.

    Takes at most 2 s, or longer to look up a name.
    """
    protocol, _, address = endpoint.partition("/")
    if protocol not in ("tcp", "tls"):
        return "there is no answer"
    host, _, port = address.partition("#")[0].rpartition(":")
    host = host.strip("[]")
    try:
        with socket.create_connection((host, int(port)), _TIMEOUT_S) as stream:
            return _over_tls(stream, host, tls) if protocol == "tls" and tls is not None else _over_tcp(stream)
    except OSError as error:
        causes = {
            ConnectionRefusedError: "nobody listens there: is the robot, server or router up?",
            socket.gaierror: f"no machine of the name {host!r} is known here ({error.strerror})",
            TimeoutError: f"no answer within {_TIMEOUT_S:g} s: is the machine on, and is there no firewall between?",
        }
        return causes.get(type(error), error.strerror or str(error))


def _over_tls(stream: socket.socket, host: str, tls: Tls) -> str:
    greeted = False
    try:
        with tls_context(tls).wrap_socket(stream, server_hostname=host) as secured:
            greeted = True
            secured.recv(1)  # with TLS 1.3 the server checks our certificate after the handshake
    except ssl.SSLCertVerificationError as error:
        if error.verify_code in _OTHER_AUTHORITY:
            return f"its certificate is not signed by {tls.ca}"
        hint = _HINTS.get(error.verify_code, "")
        return f"its certificate is refused here: {error.verify_message.rstrip('.')}{hint}"
    except OSError as error:
        alert = (getattr(error, "reason", None) or "").partition("ALERT_")[2].lower().replace("_", " ")
        if alert in ("decrypt error", "unknown ca", "bad certificate"):
            return f"it refuses {tls.certificate}, which its own authority did not sign ({alert})"
        if alert:
            return f"it refuses {tls.certificate}: {alert}"
    return _NOT_TAKEN if greeted else _NO_TLS


_NO_TLS = "a server listens there, but does not speak TLS"
_NOT_TAKEN = (
    "a server listens there, but refuses the connection: are user and password right, and is it a server of ibrobot's?"
)


def _over_tcp(stream: socket.socket) -> str:
    """Detect a server that answers a TLS greeting and therefore needs TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(stream).close()
    except OSError as error:
        if "ALERT" not in (getattr(error, "reason", None) or ""):
            return _NOT_TAKEN
    return "it speaks TLS: write tls/ for tcp/, and give tls: {ca: …, certificate: …, key: …}"
