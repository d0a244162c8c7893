"""A child process for tests: does what its order says, and ends."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from ibrobot_core.channel import Channel
from ibrobot_core.child import run_child
from ibrobot_core.errors import ComponentFailed


def work(channel: Channel, order: dict[str, Any]) -> None:
    """Obey."""
    say(channel, order)
    if order.get("forks"):  # a process that outlives this one keeps the channel open
        subprocess.Popen(["sleep", "60"], pass_fds=(channel.fileno(),))
    if error := order.get("fail"):
        raise ComponentFailed(error)
    channel.flush()
    if number := order.get("signal"):
        os.kill(os.getpid(), number)
    if "linger" in order:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        answer(channel)
        time.sleep(order["linger"])
    if status := order.get("exit"):
        os._exit(status)


def say(channel: Channel, order: dict[str, Any]) -> None:
    """Print, log and send."""
    if text := order.get("prints"):
        print(text, file=sys.stderr, flush=True)
    for _ in range(order.get("floods", 0)):
        os.write(2, b"flood " * 10_000)
    if text := order.get("log"):
        logging.getLogger("ibrobot.test").info(text)
    for message in order.get("say", ()):
        channel.send(message)
    if size := order.get("bytes"):
        channel.send({"event": "bytes"}, bytes(range(256)) * (size // 256))
    if raw := order.get("raw"):
        channel.flush()
        os.write(channel.fileno(), bytes.fromhex(raw))


def answer(channel: Channel) -> None:
    """Answer requests until the parent hangs up."""
    while not channel.closed:
        for request in channel.receive(None):
            if request["do"] == "hang":
                threading.Event().wait()
            elif request["do"] == "die":
                os._exit(7)
            channel.send({"event": "answer", **request}, request.payload)


if __name__ == "__main__":
    sys.exit(run_child(work))
