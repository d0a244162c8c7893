"""Tokens of agents that connect by HTTP: each agent has one of its own, which a person makes, and takes away.

A token is `NAME.SECRET`. A file of that name, which only this user may read, has its hash; the token itself is nowhere.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import secrets
import stat
from pathlib import Path

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import RequestError

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}", re.ASCII)
_LONGEST = 200
"""Longest text that is looked at as a token, in characters."""


def own_folder(folder: Path, variable: str) -> Path:
    """A folder that only this user may enter, made if it is not there.

    Args:
        folder: the folder.
        variable: of the environment, which puts it elsewhere.

    Raises:
        IbrobotError: if another user owns it, or it is a link, which another user may have made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat()
    if stat.S_ISLNK(status.st_mode):
        raise IbrobotError(f"{folder} is a link: remove it, or set {variable}")
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o077:
        raise IbrobotError(f"{folder}: other users may enter it: chmod 700 {folder}, or set {variable}")
    return folder


def tokens_folder() -> Path:
    """The folder with a file for each agent: `$XDG_CONFIG_HOME/ibrobot/agents`, by default in `~/.config`."""
    home = Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return own_folder(home / "ibrobot" / "agents", "XDG_CONFIG_HOME")


def add_token(name: str) -> str:
    """Make the token of an agent, which is not shown again.

    Raises:
        IbrobotError: for a name that is taken, or no name.
    """
    if not _NAME.fullmatch(name):
        raise RequestError(f"agent {name!r}: a name has letters, digits, - and _, 40 at most, e.g. claude")
    token = f"{name}.{secrets.token_urlsafe(32)}"
    path = tokens_folder() / name
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600)
    except FileExistsError:
        raise RequestError(f"agent {name} has a token; `ibrobot agent remove {name}` takes it away") from None
    with os.fdopen(descriptor, "w") as file:
        file.write(_hash(token))
    return token


def remove_token(name: str) -> None:
    """Take away the token of an agent: it is disconnected, and what it was granted ends.

    Raises:
        IbrobotError: if it has none.
    """
    try:
        if not _NAME.fullmatch(name):
            raise FileNotFoundError
        (tokens_folder() / name).unlink()
    except FileNotFoundError:
        known = ", ".join(named_agents()) or "none"
        raise RequestError(f"agent {name!r} has no token; these have one: {known}") from None


def named_agents() -> list[str]:
    """The agents that have a token."""
    return sorted(each.name for each in tokens_folder().iterdir() if _NAME.fullmatch(each.name))


def agent_of(token: str) -> str:
    """The name of the agent that has a token; empty if none has it, or the folder is not this user's alone."""
    name = token.partition(".")[0]
    if len(token) > _LONGEST or not _NAME.fullmatch(name):
        return ""
    try:
        kept = (tokens_folder() / name).read_bytes()[:_LONGEST]
    except (OSError, IbrobotError):  # or others may enter the folder
        return ""
    return name if hmac.compare_digest(kept, _hash(token).encode()) else ""


def _hash(token: str) -> str:
    """What is kept of a token: its secret has 256 bits, so that nobody finds it by trying."""
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()
