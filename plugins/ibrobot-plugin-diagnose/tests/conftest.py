"""The process from which jobs fork."""

import multiprocessing
from multiprocessing import forkserver

import pytest


@pytest.fixture(scope="session")
def fork_server() -> None:
    """It lives as long as the interpreter, as does the memory of the first value, so they are not leaks."""
    multiprocessing.get_context("forkserver").Value("q", 0)
    forkserver.ensure_running()
