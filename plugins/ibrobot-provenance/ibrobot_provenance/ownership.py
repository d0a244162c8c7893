"""Who owns an episode or a dataset: a lock of the operating system, which ends with its process, however that ends."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import time
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import override

from ibrobot_core.api import IbrobotError

_LONGEST = 200
"""Longer names are replaced by a hash, since the name of the lock file would be too long [bytes]."""
_POLL_S = 0.02
_READ_ONLY = frozenset({errno.EROFS, errno.EACCES, errno.EPERM})


class InUse(IbrobotError):
    """An episode or a dataset has another owner, e.g. because it is being recorded."""

    from_input = False


class Ownership(AbstractContextManager["Ownership"]):
    """The right to change a folder, or with `shared` to read it while nobody changes it; until `close`.

    The lock (`flock`) is on a hidden file beside the folder, so that it covers the folder's name while the folder is
    created, replaced or removed. The file has a line for each owner, which names it. The last owner removes the file;
    after a kill it stays, without effect.

    Args:
        path: the folder, which need not exist; or one of an episode's files, for their folder.
        doing: what the owner does to it, for others' errors, e.g. `is being recorded`.
        file: the lock file, if it is not beside the folder.
        shared: whether others may share it.
        wait_s: how long to wait for another owner [s]; the default is enough for owners that end at once.

    Raises:
        InUse: if it has another owner; names what that does, and its process.
        OSError: if the lock file cannot be created. To share a folder that cannot be written, no file is needed.
    """

    def __init__(
        self, path: Path, doing: str, *, file: Path | None = None, shared: bool = False, wait_s: float = 0.5
    ) -> None:
        self.path = path
        self._file = file or lock_file(path)
        self._descriptor: int | None = None
        self._line = 0, 0
        """Begin and end of the own line in the file [bytes]."""
        deadline_s = time.monotonic() + wait_s
        while not self._acquire(shared):
            if time.monotonic() >= deadline_s:
                raise InUse(f"{path}: {self._owner()}; try again when that has ended")
            time.sleep(_POLL_S)
        if self._descriptor is not None:
            with suppress(OSError):  # only others' errors need it
                if not shared:
                    os.ftruncate(self._descriptor, 0)
                size = os.write(self._descriptor, f"{doing} by process {os.getpid()}\n".encode())
                end = os.lseek(self._descriptor, 0, os.SEEK_CUR)
                self._line = end - size, end

    @override
    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Give it up. Safe to call twice."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is None:
            return
        begin, end = self._line
        with suppress(OSError):  # it cannot be written
            fcntl.fcntl(descriptor, fcntl.F_SETFL, 0)  # does not append any more
            os.pwrite(descriptor, b"\n" * (end - begin), begin)
        with suppress(OSError):  # others share it, or it cannot be removed
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, self._file):
                self._file.unlink()
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_UN)  # a process forked meanwhile has the file open, too
        os.close(descriptor)

    def _acquire(self, shared: bool) -> bool:
        """Lock the file; returns whether that succeeded."""
        while True:
            if (descriptor := _open(self._file, shared)) is None:
                return True
            try:
                fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                os.close(descriptor)
                return False
            except OSError:
                os.close(descriptor)
                raise
            if _is_at(descriptor, self._file):
                self._descriptor = descriptor
                return True
            os.close(descriptor)  # its last owner removed it after it was opened here

    def _owner(self) -> str:
        lines: list[str] = []
        with suppress(OSError):
            lines = [line for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines() if line]
        here = [line for line in lines if _runs(line.rpartition(" ")[2])]  # others may have been killed
        return (here or lines or ["is being changed by another process"])[-1]


def owned(
    path: Path, doing: str, error: type[IbrobotError], *, file: Path | None = None, shared: bool = False,
    wait_s: float = 0.5,
) -> Ownership:  # fmt: skip
    """Own a folder, and create the missing folders above its lock file; the other arguments are those of `Ownership`.

    Raises:
        InUse: if it has another owner.
        IbrobotError: of type `error`, if it cannot be locked, e.g. on a read-only disk.
    """
    try:
        if not shared:
            (file or path).parent.mkdir(parents=True, exist_ok=True)
        return Ownership(path, doing, file=file, shared=shared, wait_s=wait_s)
    except OSError as failed:
        raise error(f"{path}: cannot be {'locked' if shared else 'written'}: {failed.strerror}") from failed


def lock_file(path: Path) -> Path:
    """The lock file of a folder, beside it."""
    folder = path.resolve()
    if folder.is_file():
        folder = folder.parent
    name = os.fsencode(folder.name)
    short = folder.name if len(name) <= _LONGEST else hashlib.sha256(name).hexdigest()
    return folder.with_name(f".{short}.lock")


def _runs(process: str) -> bool:
    """Whether a process with this number runs on this machine."""
    try:
        os.kill(int(process), 0)
    except PermissionError:
        return True
    except (OSError, ValueError, OverflowError):
        return False
    return True


def _open(file: Path, shared: bool) -> int | None:
    """Open a lock file; None if there is none and nobody can create one here."""
    try:
        return os.open(file, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if not shared or error.errno not in _READ_ONLY:
            raise
    try:
        return os.open(file, os.O_RDONLY | os.O_NOFOLLOW)
    except FileNotFoundError:
        return None


def _is_at(descriptor: int, file: Path) -> bool:
    """Whether the open file is still the one at its path."""
    try:
        return os.path.samestat(os.fstat(descriptor), file.stat(follow_symlinks=False))
    except FileNotFoundError:
        return False
