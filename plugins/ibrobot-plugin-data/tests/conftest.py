"""Runs of the fake robot, and the process from which conversions fork."""

import multiprocessing
from multiprocessing import forkserver

import pytest
from fake_runs import runs, site

__all__ = ["runs", "site"]


@pytest.fixture(scope="session")
def fork_server() -> None:
    """It lives as long as the interpreter, as does the memory of the first value, so they are not leaks."""
    multiprocessing.get_context("forkserver").Value("q", 0)
    forkserver.ensure_running()
