"""Pools: where jobs run, in processes of this machine or of others."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable
from typing import Any

import attrs

from ibrobot_core.bug_reports import error_text
from ibrobot_core.errors import ComponentFailed, IbrobotError


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
