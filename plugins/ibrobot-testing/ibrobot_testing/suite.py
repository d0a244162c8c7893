"""Base of the conformance suites: a context, `make`, and a way to run the checks without pytest."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import pytest

from ibrobot_core.api import Context
from ibrobot_testing.contexts import host_context
from ibrobot_testing.leaks import LeakCheck

_POLL_S = 0.002


class Suite[T]:
    """Base of the suites. A plugin's test subclasses one, with a name that begins with `Test`, and defines `make`.

    Attributes:
        leak_check: check for leaked resources. An exception needs a reason:
            `leak_check = LeakCheck(allow={"thread": "libfoo keeps its thread until the process ends"})`.
    """

    leak_check: ClassVar[LeakCheck] = LeakCheck()

    @pytest.fixture(autouse=True)
    def no_leaks(self) -> Iterator[None]:
        """Fail a check that leaks a thread, a process, an open file or a port."""
        with self.leak_check.watch():
            yield

    def make(self, ctx: Context) -> T:
        """A new object under test, not yet connected, opened or loaded."""
        raise NotImplementedError(f"{type(self).__name__} must define make(self, ctx)")

    def context(self) -> Context:
        """The context for `make`; override for another robot, clock or options."""
        return host_context()

    @contextmanager
    def in_use(
        self, begin: Callable[[T], object], end: Callable[[T], object], *, again: bool = False
    ) -> Iterator[tuple[T, Context]]:
        """A new object under test between `begin` and `end`, with its context.

        Args:
            begin: connects, opens or loads it.
            end: disconnects or closes it, which is safe at any time.
            again: whether it ended before it began, began, and ended twice.
        """
        ctx = self.context()
        subject = self.make(ctx)
        for step in (end, begin, end, end) if again else ():
            step(subject)
        try:
            begin(subject)
            yield subject, ctx
        finally:
            end(subject)


def wait_until(condition: Callable[[], bool], patience_s: float) -> None:
    """Wait until `condition` holds.

    Raises:
        AssertionError: if it does not within `patience_s` [s].
    """
    deadline_s = time.monotonic() + patience_s
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen in time"
        time.sleep(_POLL_S)


def run_checks[T](suite: type[Suite[T]], directory: Path) -> dict[str, BaseException | None]:
    """Run every check of `suite`, to test the suites themselves or wrong implementations.

    Args:
        suite: the suite, with its `make`.
        directory: folder for the files of checks.

    Returns:
        Name of the check -> its exception, or None if it passed; without skipped checks.
    """
    results: dict[str, BaseException | None] = {}
    for name, check in inspect.getmembers(suite, inspect.isfunction):
        if not name.startswith("test_"):
            continue
        tmp_path = directory / name
        tmp_path.mkdir(parents=True)
        bound: Callable[..., None] = getattr(suite(), name)
        try:
            with suite.leak_check.watch():
                bound(tmp_path) if "tmp_path" in inspect.signature(check).parameters else bound()
        except pytest.skip.Exception:
            continue
        except (Exception, pytest.fail.Exception) as error:  # noqa: BLE001 - what was raised is the result
            results[name] = error
        else:
            results[name] = None
    return results


def failed_checks[T](suite: type[Suite[T]], directory: Path) -> set[str]:
    """Names of the checks of `suite` that fail, without their `test_`; see `run_checks`."""
    return {name.removeprefix("test_") for name, error in run_checks(suite, directory).items() if error is not None}


def checks[T](suite: type[Suite[T]]) -> set[str]:
    """Names of all checks of `suite`, without their `test_`."""
    return {name.removeprefix("test_") for name in dir(suite) if name.startswith("test_")}
