"""Identity of a machine: the name and role in its certificate."""

from __future__ import annotations

from enum import Enum
from pathlib import Path

import attrs
from cryptography import x509
from cryptography.x509.oid import NameOID

from ibrobot_core.api import TransportError
from ibrobot_zenoh.options import Tls, ZenohOptions
from ibrobot_zenoh.reasons import tls_context


class Role(Enum):
    """Role of a machine in its certificate."""

    SERVER = "server"
    """Answers requests; others may connect to it."""
    ROBOT = "robot"
    """Only connects: it asks servers, and publishes in its own name."""


@attrs.frozen
class Identity:
    """The name and role in a certificate."""

    name: str
    role: Role

    def check_may_publish(self, topic: str) -> None:
        """Check that a robot publishes only in its own name, because a server silently drops other topics.

        Raises:
            TransportError: if it does not, e.g. for `/robot2/joint_states` of robot1.
        """
        if self.role is Role.ROBOT and not topic.strip("/").startswith(f"{self.name}/"):
            raise TransportError(
                f"{topic}: {self.name} may publish only below /{self.name}; remove transport.namespace, or begin it "
                f"with {self.name}"
            )


def subject(identity: Identity) -> x509.Name:
    """A certificate's subject: the name is its common name, the role its organizational unit."""
    return x509.Name(
        [
            x509.NameAttribute(NameOID.COMMON_NAME, identity.name),
            x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, identity.role.value),
        ]
    )


def read_identity(tls: Tls) -> Identity:
    """The name and role in a machine's certificate.

    Raises:
        TransportError: if the certificate has no role, or as `tls_context`.
    """
    tls_context(tls)
    return identity_in(tls.certificate)


def identity_in(certificate: Path) -> Identity:
    """The name and role in a certificate file.

    Raises:
        TransportError: if the certificate has no role.
    """
    owner = x509.load_pem_x509_certificate(certificate.read_bytes()).subject
    names = owner.get_attributes_for_oid(NameOID.COMMON_NAME)
    roles = owner.get_attributes_for_oid(NameOID.ORGANIZATIONAL_UNIT_NAME)
    if len(names) != 1 or len(roles) != 1 or roles[0].value not in {role.value for role in Role}:
        raise TransportError(
            f"{certificate}: has no role (server or robot), so the permissions of its machine are unknown; replace the "
            "certificates of all machines by new ones: `ibrobot certs NEW_FOLDER --server HOST --robot NAME`"
        )
    return Identity(str(names[0].value), Role(roles[0].value))


def own_identity(options: ZenohOptions) -> Identity | None:
    """The identity of this machine: from its certificate, or else its user name; None without either.

    Raises:
        TransportError: as `read_identity`.
    """
    if options.tls is not None:
        return read_identity(options.tls)
    return None if options.user is None else Identity(options.user, Role.ROBOT)
