"""Messages of episodes in the log of an evaluation."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
from ibrobot_eval.episodes import hide_messages


@pytest.fixture(autouse=True)
def _loggers() -> Iterator[None]:
    log, requests = logging.getLogger("ibrobot"), logging.getLogger("ibrobot.inference")
    level, filters = log.level, [*requests.filters]
    requests.filters.clear()
    yield
    log.setLevel(level)
    requests.filters[:] = filters


def fail(text: str) -> None:
    log = logging.getLogger("ibrobot.inference")
    try:
        raise RuntimeError(text)
    except RuntimeError:
        log.exception("the policy failed")
    log.error("a message about %s", text)


def test_equal_errors_of_requests_are_shown_once(caplog: pytest.LogCaptureFixture) -> None:
    """A policy that raises at each request of a thousand episodes would bury the progress under its tracebacks."""
    for number in range(30):
        hide_messages()
        fail(f"error {number % 3} of the test")
    traces = [str(each.exc_info[1]) for each in caplog.records if each.exc_info]
    assert traces == [f"error {number} of the test" for number in range(3)]
    assert len(caplog.records) == 30 + 3, "a message without a traceback is short"
