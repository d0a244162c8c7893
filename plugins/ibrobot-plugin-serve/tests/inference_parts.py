"""A simulation and policies for an inference process of its own."""

from __future__ import annotations

import os
import signal

import numpy as np
from ibrobot_testing.fakes import FakeHardware, FakePolicy

from ibrobot_core.api import HardwareDescriptor, PolicyDescriptor, PolicyError, hookimpl


class Net(FakePolicy):
    """Does what the tensor `do` says."""

    seeds: tuple[int, ...] = ()

    def load(self):
        print(end="")
        self.loaded = True

    def weights(self):
        from pathlib import Path

        return (Path(__file__).parent / "weights").read_text() if (Path(__file__).parent / "weights").exists() else ""

    def reset(self, seed):
        self.seeds += (seed,)

    def infer(self, tensors):
        assert self.loaded
        do = tensors["do"].tobytes().decode() if "do" in tensors else ""
        if do == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if do == "exit":
            os._exit(3)
        if do == "hang":
            while True:
                signal.pause()
        if do == "fail":
            raise ValueError("not today")
        if do == "object":
            return {"o": np.array([object()])}
        return {"twice": tensors["x"] * 2, "pid": np.array([os.getpid()]), "seeds": np.array(self.seeds, np.int64)}


class Lost(FakePolicy):
    def load(self):
        raise PolicyError("no such checkpoint: nowhere")


@hookimpl
def ibrobot_hardware():
    yield HardwareDescriptor("scene", lambda options, ctx: FakeHardware(ctx), "a scene", simulated=True)


@hookimpl
def ibrobot_policies():
    yield PolicyDescriptor("net", lambda options, ctx: Net(ctx), "a network")
    yield PolicyDescriptor("plain", lambda options, ctx: FakePolicy(ctx), "a network without tricks")
    yield PolicyDescriptor("lost", lambda options, ctx: Lost(ctx), "a network that is not there")
