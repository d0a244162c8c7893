"""`ibrobot certs`: a private authority and certificates for a lab's machines, and the YAML that uses them."""

from __future__ import annotations

import re
from pathlib import Path

import click
from ibrobot_http.certificates import CERTIFICATE, KEY

from ibrobot_core.api import TransportError
from ibrobot_core.app import echo, wrong_input
from ibrobot_zenoh.certificates import CA, ROBOTS, Authority
from ibrobot_zenoh.options import check_robot_name

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_PORT = 7447
_FILES = {"ca": CA, "certificate": CERTIFICATE, "key": KEY}


@click.command()
@click.argument("out_dir", type=click.Path(path_type=Path, file_okay=False))
@click.option(
    "--server", "servers", multiple=True, metavar="HOST[,IP…]", help="A server, with all its names and addresses."
)
@click.option("--robot", "robots", multiple=True, metavar="NAME", help="A robot, which only connects.")
@click.option("--days", default=1825, show_default=True, type=click.IntRange(1, 7300), help="Validity in days.")
@wrong_input()
def certs(out_dir: Path, servers: tuple[str, ...], robots: tuple[str, ...], days: int) -> None:
    """Make certificates for a lab in OUT_DIR: a private authority, and a folder to copy to each machine.

    A certificate contains its machine's name and role. Servers answer requests; robots ask, and publish in their own
    name. Repeat --server and --robot as needed. A server admits the robots listed in robots.txt in its folder.

    If OUT_DIR already has an authority, it signs the new certificates, and new robots are added to every robots.txt. No
    certificate or key is overwritten. Anyone with OUT_DIR/ca.key can make certificates: do not copy it to the machines.
    """
    if not servers and not robots:
        raise click.UsageError("give a --server or a --robot, e.g. --server gpu.lab,192.168.1.5 --robot robot1")
    hosts = {names[0]: names for server in servers for names in (server.split(","),)}
    machines = [*hosts, *robots]
    for name in (*(host for names in hosts.values() for host in names), *robots):
        if not _NAME.fullmatch(name.replace(":", "")):
            raise click.UsageError(f"{name!r} is not a valid name: letters, digits, '.', '_' and '-' only")
    for robot in robots:
        try:
            check_robot_name(robot)
        except ValueError as error:
            raise click.UsageError(f"--robot: {error}") from None
    taken = [name for name in machines if (out_dir / name).exists() or machines.count(name) > 1]
    if taken:
        raise TransportError(f"{out_dir / taken[0]} exists already, or is given twice; nothing is overwritten")
    try:
        authority = Authority(out_dir, days)
        made = [authority.issue(name, hosts.get(name, ())) for name in machines]
        lists = authority.admit(robots)
    except OSError as error:
        raise TransportError(f"{error.filename or out_dir}: cannot be written: {error.strerror}") from error
    action = "made" if authority.is_new else "signed by"
    echo(f"{action} the authority {out_dir / CA}; all is valid until {authority.ends:%Y-%m-%d}")
    server = next(iter(hosts), "SERVER")
    endpoint = f'"tls/[{server}]:{_PORT}"' if ":" in server else f"tls/{server}:{_PORT}"
    for name, folder in zip(machines, made, strict=True):
        if name in hosts:
            _print_yaml(folder, "mode: router", f"listen: [tls/0.0.0.0:{_PORT}]", files={**_FILES, "robots": ROBOTS})
        else:
            _print_yaml(folder, f"connect: [{endpoint}]", files=_FILES)
    for path in lists:
        if robots and path.parent.name not in hosts:
            echo(f"\n# {path.parent.name}: copy {path} there again and restart it to admit the robot")


def _print_yaml(folder: Path, *lines: str, files: dict[str, str]) -> None:
    """Print a machine's YAML."""
    echo(f"\n# {folder.name}: copy {folder}/ there, beside its YAML, which says:\ntransport:\n  type: zenoh")
    for line in lines:
        echo(f"  {line}")
    echo("  tls:")
    for key, file in files.items():
        echo(f"    {key}: {folder.name}/{file}")
