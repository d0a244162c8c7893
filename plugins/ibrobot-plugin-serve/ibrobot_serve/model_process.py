"""The model process: loads one policy and runs its `infer` for one robot, until the host ends it or dies.

Started by `ibrobot_serve.process` as a `Child` with the descriptors REQUEST and ANSWER: memory for the frames
of the wire format, one each way.
"""

from __future__ import annotations

import mmap
import os
import sys
import threading
import time
from pathlib import Path

import attrs

from ibrobot_core.api import Policy
from ibrobot_core.app import (
    Channel,
    ComponentFailed,
    Failure,
    build_policy,
    error_text,
    from_document,
    installed_plugins,
    open_parent,
)
from ibrobot_serve.wire import WIRE_LIMITS, WireDecoder, WireEncoder, WireKind, WireMessage

_GLANCE_S = 0.5
"""Period of the check that the host is alive [s]."""
_NICE = 5
"""Below the priority of the host, which reads cameras and sends plans while the model computes."""


@attrs.define
class ModelLoop:
    """Answers requests one after the other."""

    policy: Policy
    channel: Channel
    request: memoryview
    answer: memoryview
    episode: int | None = None
    encoder: WireEncoder = attrs.field(factory=WireEncoder)
    decoder: WireDecoder = attrs.field(factory=WireDecoder)

    def run(self) -> None:
        """Answer until the host hangs up."""
        while True:
            try:
                order = self.channel.wait(None)[-1]  # the host gave up the earlier ones
            except ComponentFailed:
                return
            size = self._answered(order["id"], order["size"])
            self.channel.send({"event": "answer", "id": order["id"], "size": size, "identity": self.policy.identity()})

    def _answered(self, request_id: int, size: int) -> int:
        """Answer the request in memory; returns the size of the answer's frame."""
        begun_ns = time.monotonic_ns()
        try:
            message = self.decoder.decode(self.request[:size])
            if message.episode != self.episode:
                self.policy.reset(message.seed)
                self.episode = message.episode
            outputs = self.policy.infer(message.tensors)
            latency_ms = (time.monotonic_ns() - begun_ns) / 1e6
            return self._put(WireMessage(WireKind.ANSWER, request_id, outputs, latency_ms=latency_ms))
        except Exception as error:  # noqa: BLE001 - contained: the answer has the error
            return self._put(WireMessage(WireKind.FAILURE, request_id, text=error_text(error)))

    def _put(self, message: WireMessage) -> int:
        return len(self.encoder.encode(message, lambda size: self.answer[:size]))


def _end_with(host: int) -> None:
    while os.getppid() == host:
        time.sleep(_GLANCE_S)
    os._exit(1)


def main(parent: int, request: int, answer: int) -> int:
    """Run with the host's channel and memories; returns the exit status."""
    channel = open_parent(parent)
    os.nice(_NICE)
    policy = None
    try:
        order = channel.wait(None)[0]
        threading.Thread(target=_end_with, args=(order["host"],), daemon=True).start()
        registry = installed_plugins()
        config = from_document(order["document"], source=Path(order["source"]), sim=order["sim"], registry=registry)
        policy = build_policy(config, registry, order["model"], order["seed"])
        policy.load()
        channel.send({
            "event": "ready", "fingerprint": policy.fingerprint(), "weights": policy.weights(),
            "identity": policy.identity(),
        })  # fmt: skip
        frames = [memoryview(mmap.mmap(descriptor, WIRE_LIMITS.size)) for descriptor in (request, answer)]
        ModelLoop(policy, channel, frames[0], frames[1]).run()
    except Exception as error:  # noqa: BLE001 - the host reports it
        channel.report(Failure(error_text(error)))
        return 1
    finally:
        if policy is not None:
            policy.close()
        channel.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(*(int(argument) for argument in sys.argv[1:])))
