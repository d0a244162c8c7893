"""The section `mcp`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import attrs
from ibrobot_http.addresses import check_name, is_loopback

from ibrobot_core.api import OptionFault, Options, documented, option

if TYPE_CHECKING:
    from ibrobot_core.api import Robot


SECTION = "mcp"


@documented
@attrs.frozen
class McpOptions(Options):
    """Options of the section `mcp`."""

    http: bool = option(True, help="whether agents connect by HTTP; `ibrobot mcp` needs none")
    host: str = option("127.0.0.1", validator=check_name, help="address on which the port listens")
    port: int = option(0, ge=0, le=65535, help="port for /mcp; 0: any free port")
    names: tuple[str, ...] = option(
        (), validator=attrs.validators.deep_iterable(check_name), help="further host names of this machine"
    )
    certificate: Path | None = option(None, help="TLS certificate, with the chain of its authority")
    key: Path | None = option(None, help="private key of the certificate")

    def __attrs_post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key belong together; give both, or none of them")
        if self.http and not is_loopback(self.host) and self.certificate is None:
            raise ValueError(
                f"host {self.host} can be reached from the network, which needs TLS: give certificate and key, or use "
                "127.0.0.1 and an SSH tunnel"
            )

    def check(self, robot: Robot, joints: tuple[str, ...]) -> Iterable[OptionFault]:
        """Check that the files of the certificate exist."""
        for name, path in (("certificate", self.certificate), ("key", self.key)):
            if path is not None and not path.is_file():
                yield OptionFault((name,), f"{path}: no such file")
