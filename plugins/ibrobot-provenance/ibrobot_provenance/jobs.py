"""Jobs, and pools: where they run, in processes of this machine or of others."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable
from typing import Any

import attrs

from ibrobot_core.api import Descriptor, IbrobotError
from ibrobot_core.app import ComponentFailed, error_text, installed_plugins


@attrs.frozen(eq=False)
class Job[R]:
    """Work for a process of a pool: a pure function of its argument and of files.

    A job whose process is killed is run again, and may then run twice at once. So what it writes must appear completely
    or not at all, and be the same every time.
    """

    function: Callable[[Any, Callable[[int], None]], R]
    """A function of an installed module. It gets the argument, and a function that counts its progress, e.g. frames; it
    calls the latter in its own thread."""
    argument: Any
    """Can be pickled, as can the result."""
    own_process: bool = False
    """Whether it needs a process that has run no other job, e.g. because a library leaks memory."""
    gpus: int = 0
    """GPUs that it uses alone, on machines that have some; for pools that share out GPUs."""

    def run(self, progress: Callable[[int], None]) -> tuple[R | None, IbrobotError | None]:
        """Run the job in this process; returns its result, or its error. For pools."""
        try:
            return self.function(self.argument, progress), None
        except IbrobotError as error:
            return None, _that_travels(error)
        except Exception as error:  # noqa: BLE001 - a bug in a job is reported like an error
            return None, ComponentFailed(error_text(error))


def _that_travels(error: IbrobotError) -> IbrobotError:
    """An error that can be pickled: itself, or one with its text and exit code."""
    try:
        return copy.copy(error)  # made as pickle makes it
    except Exception:  # noqa: BLE001 - whatever its class needs
        return ComponentFailed(str(error), error.exit_code)


@attrs.frozen(eq=False)
class Done[R]:
    """A job that is done."""

    job: Job[R]
    value: R | None = None
    error: IbrobotError | None = None
    """Why it failed; None if it did not."""

    def result(self) -> R:
        """What the function returned.

        Raises:
            IbrobotError: if the job failed.
        """
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]


class Pool(ABC):
    """Runs jobs in other processes, which have the folder of this one, and the same packages."""

    @abstractmethod
    def run[R](self, jobs: Iterable[Job[R]], watch: Callable[[int], None] = lambda count: None) -> Generator[Done[R]]:
        """Run jobs, and yield each as soon as it is done.

        Jobs begin in their order, and are taken from `jobs` when there is room for them. A job whose process dies is
        run again, and has failed if several processes have died with it. Closing the generator ends the running jobs.

        Args:
            jobs: the jobs.
            watch: called several times per second with the progress that all jobs have counted so far.

        Raises:
            ComponentFailed: if the pool has failed, e.g. because its machines cannot be reached.
        """

    def close(self) -> None:
        """Leave the machines of the pool; does nothing by default."""


@attrs.frozen
class PoolDescriptor(Descriptor[Pool]):
    """A pool, where jobs run. Its type and its address are those of the option `--on` of commands."""

    make: Callable[[str, int | None], Pool] = attrs.field(kw_only=True)  # type: ignore[assignment]
    """Address and number of jobs at a time -> the pool. The address is what follows `TYPE://`, or empty; the number is
    None for as many as there is room for. Imports what it needs when it is called.

    Raises:
        RequestError: e.g. for an address that the pool does not have.
        ComponentFailed: if its machines cannot be reached.
    """


def open_pool(where: str, jobs: int | None = None) -> Pool:
    """A new pool, which the caller closes.

    Args:
        where: type, or `TYPE://ADDRESS`; empty for the default.
        jobs: number of jobs at a time; None for as many as there is room for.

    Raises:
        IbrobotError: e.g. if its package is not installed, which the error names, or it cannot be reached.
    """
    descriptor, address = _pool_type(where)
    return descriptor.make(address, jobs)


def check_pool(where: str) -> None:
    """Check, before long work is planned, that a pool's package is installed.

    Raises:
        IbrobotError: if it is not.
    """
    _pool_type(where)


def _pool_type(where: str) -> tuple[PoolDescriptor, str]:
    """The descriptor and the address of a pool."""
    registry = installed_plugins()
    type_, _, address = (where or registry.default("pool")).partition("://")
    descriptor = registry.find("pool", type_)
    assert isinstance(descriptor, PoolDescriptor)
    descriptor.check()
    return descriptor, address
