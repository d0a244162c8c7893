"""Sensors that leave something behind when they are closed, and their suites; `test_leaks.py` runs them."""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import threading
from typing import ClassVar, override

from ibrobot_testing import LeakCheck, SensorSuite
from ibrobot_testing.fakes import FakeSensor

from ibrobot_core.api import Context

kept: list[object] = []
"""What was left behind: without it, Python would close it."""


class LeavesAThread(FakeSensor):
    @override
    def open(self) -> None:
        super().open()
        thread = threading.Thread(target=threading.Event().wait, name="grabber", daemon=True)
        thread.start()


class LeavesAProcess(FakeSensor):
    @override
    def open(self) -> None:
        super().open()
        # It ends with this process, which closes its input.
        command = [sys.executable, "-c", "print(flush=True); input()"]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()  # it has begun
        kept.append(process)


class LeavesAFile(FakeSensor):
    @override
    def open(self) -> None:
        super().open()
        kept.append(tempfile.TemporaryFile())  # noqa: SIM115 - left open on purpose


class LeavesAPort(FakeSensor):
    @override
    def open(self) -> None:
        super().open()
        kept.append(socket.create_server(("127.0.0.1", 0)))


class BriefSuite(SensorSuite):
    """What is left is left for good."""

    leak_check: ClassVar[LeakCheck] = LeakCheck(grace_s=0.0)


class TestThread(BriefSuite):
    @override
    def make(self, ctx: Context) -> LeavesAThread:
        return LeavesAThread(ctx)


class TestProcess(BriefSuite):
    @override
    def make(self, ctx: Context) -> LeavesAProcess:
        return LeavesAProcess(ctx)


class TestFile(BriefSuite):
    @override
    def make(self, ctx: Context) -> LeavesAFile:
        return LeavesAFile(ctx)


class TestPort(BriefSuite):
    @override
    def make(self, ctx: Context) -> LeavesAPort:
        return LeavesAPort(ctx)


class TestAllowedThread(TestThread):
    leak_check: ClassVar[LeakCheck] = LeakCheck(allow={"thread": "the driver keeps it until the process ends"})


class TestAllowedPort(TestPort):
    leak_check: ClassVar[LeakCheck] = LeakCheck(allow={"port": "the driver keeps it until the process ends"})
