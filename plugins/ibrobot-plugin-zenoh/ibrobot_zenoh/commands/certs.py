"""`ibrobot certs`: a private authority and certificates for a lab's machines, and the YAML that uses them."""

from __future__ import annotations

import re
from pathlib import Path

import attrs
from ibrobot_http.certificates import CERTIFICATE, KEY

from ibrobot_core.api import TransportError, option
from ibrobot_core.app import RequestError, echo, wrong_input
from ibrobot_zenoh.certificates import CA, ROBOTS, Authority
from ibrobot_zenoh.options import check_robot_name

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_PORT = 7447
_FILES = {"ca": CA, "certificate": CERTIFICATE, "key": KEY}


@attrs.frozen(kw_only=True)
class MakeCertificates:
    """Make certificates for a lab in OUT_DIR: a private authority, and a folder to copy to each machine.

    A certificate contains its machine's name and role. Servers answer requests; robots ask, and publish in their own
    name. Repeat --server and --robot as needed. A server admits the robots listed in robots.txt in its folder.

    If OUT_DIR already has an authority, it signs the new certificates, and new robots are added to every robots.txt. No
    certificate or key is overwritten. Anyone with OUT_DIR/ca.key can make certificates: do not copy it to the machines.
    """

    out_dir: Path = option(typed="OUT_DIR", help="the folder")
    servers: tuple[str, ...] = option(
        (), typed="--server HOST[,IP…]", help="a server, with all its names and addresses"
    )
    robots: tuple[str, ...] = option((), typed="--robot NAME", help="a robot, which only connects")
    days: int = option(1825, ge=1, le=7300, help="validity in days")

    @wrong_input()
    def __call__(self) -> None:
        if not self.servers and not self.robots:
            raise RequestError("give a --server or a --robot, e.g. --server gpu.lab,192.168.1.5 --robot robot1")
        hosts = {names[0]: names for server in self.servers for names in (server.split(","),)}
        machines = [*hosts, *self.robots]
        for name in (*(host for names in hosts.values() for host in names), *self.robots):
            if not _NAME.fullmatch(name.replace(":", "")):
                raise RequestError(f"{name!r} is not a valid name: letters, digits, '.', '_' and '-' only")
        for robot in self.robots:
            try:
                check_robot_name(robot)
            except ValueError as error:
                raise RequestError(f"--robot: {error}") from None
        taken = [name for name in machines if (self.out_dir / name).exists() or machines.count(name) > 1]
        if taken:
            raise TransportError(f"{self.out_dir / taken[0]} exists already, or is given twice; nothing is overwritten")
        try:
            authority = Authority(self.out_dir, self.days)
            made = [authority.issue(name, hosts.get(name, ())) for name in machines]
            lists = authority.admit(self.robots)
        except OSError as error:
            raise TransportError(f"{error.filename or self.out_dir}: cannot be written: {error.strerror}") from error
        action = "made" if authority.is_new else "signed by"
        echo(f"{action} the authority {self.out_dir / CA}; all is valid until {authority.ends:%Y-%m-%d}")
        server = next(iter(hosts), "SERVER")
        endpoint = f'"tls/[{server}]:{_PORT}"' if ":" in server else f"tls/{server}:{_PORT}"
        for name, folder in zip(machines, made, strict=True):
            if name in hosts:
                _print_yaml(
                    folder, "mode: router", f"listen: [tls/0.0.0.0:{_PORT}]", files={**_FILES, "robots": ROBOTS}
                )
            else:
                _print_yaml(folder, f"connect: [{endpoint}]", files=_FILES)
        for path in lists:
            if self.robots and path.parent.name not in hosts:
                echo(f"\n# {path.parent.name}: copy {path} there again and restart it to admit the robot")


def _print_yaml(folder: Path, *lines: str, files: dict[str, str]) -> None:
    """Print a machine's YAML."""
    echo(f"\n# {folder.name}: copy {folder}/ there, beside its YAML, which says:\ntransport:\n  type: zenoh")
    for line in lines:
        echo(f"  {line}")
    echo("  tls:")
    for key, file in files.items():
        echo(f"    {key}: {folder.name}/{file}")
