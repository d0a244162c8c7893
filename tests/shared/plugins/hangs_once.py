"""A policy that hangs once."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import attrs
import numpy as np
from ibrobot_testing import host_context
from ibrobot_testing.fakes import FakePolicy

from ibrobot_core import hookimpl
from ibrobot_core.api import Options
from ibrobot_core.descriptors import PolicyDescriptor


@attrs.frozen
class GivenOptions(Options):
    path: Path


class HangsOnce(FakePolicy):
    def __init__(self, options, ctx):
        super().__init__(host_context())
        self.mark = options.path / "hung"

    def infer(self, tensors):
        if not self.mark.exists():
            self.mark.touch()
            threading.Event().wait()
        return {"pid": np.array([os.getpid()])}


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("hangs_once", HangsOnce, "hangs at its first request", GivenOptions)
