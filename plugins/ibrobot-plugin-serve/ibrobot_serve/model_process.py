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
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ibrobot_core.api import Policy
from ibrobot_core.app import Channel, error_text, from_document, installed_plugins, run_child
from ibrobot_serve.wire import WIRE_LIMITS, WireDecoder, WireEncoder, WireKind, WireMessage

_GLANCE_S = 0.5
"""Period of the check that the host is alive [s]."""
_NICE = 5
"""Below the priority of the host, which reads cameras and sends plans while the model computes."""


def answer_requests(policy: Policy, channel: Channel, request: memoryview, answer: memoryview) -> None:
    """Answer requests one after the other, until the host hangs up."""
    encoder, decoder = WireEncoder(), WireDecoder()
    episode: int | None = None

    def encoded(message: WireMessage) -> int:
        """Put a message into memory; returns the size of its frame."""
        return len(encoder.encode(message, lambda size: answer[:size]))

    while True:
        orders = channel.receive(None)
        if channel.closed:
            return
        if not orders:
            continue
        order = orders[-1]  # the host gave up the earlier ones
        begun_ns = time.monotonic_ns()
        try:
            message = decoder.decode(request[: order["size"]])
            if message.episode != episode:
                policy.reset(message.seed)
                episode = message.episode
            outputs = policy.infer(message.tensors)
            latency_ms = (time.monotonic_ns() - begun_ns) / 1e6
            size = encoded(WireMessage(WireKind.ANSWER, order["id"], outputs, latency_ms=latency_ms))
        except Exception as error:  # noqa: BLE001 - contained: the answer has the error
            size = encoded(WireMessage(WireKind.FAILURE, order["id"], text=error_text(error)))
        channel.send({"event": "answer", "id": order["id"], "size": size, "identity": policy.identity()})


def _end_with(host: int) -> None:
    while os.getppid() == host:
        time.sleep(_GLANCE_S)
    os._exit(1)


def run(channel: Channel, order: Mapping[str, Any], request: int, answer: int) -> None:
    """Run with the host's channel and memories."""
    os.nice(_NICE)
    threading.Thread(target=_end_with, args=(order["host"],), daemon=True).start()
    registry = installed_plugins()
    config = from_document(order["document"], source=Path(order["source"]), sim=order["sim"], registry=registry)
    policy = registry.build_policy(config, order["model"], order["seed"])
    try:
        policy.load()
        channel.send({
            "event": "ready", "fingerprint": policy.fingerprint(), "weights": policy.weights(),
            "identity": policy.identity(),
        })  # fmt: skip
        frames = [memoryview(mmap.mmap(descriptor, WIRE_LIMITS.size)) for descriptor in (request, answer)]
        answer_requests(policy, channel, *frames)
    finally:
        policy.close()


if __name__ == "__main__":
    sys.exit(run_child(run))
