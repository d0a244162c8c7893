"""A child process for tests: does what its order says, and ends."""

from __future__ import annotations

import logging
import os
import sys

from ibrobot_core.child import FAREWELL_S, Failure, open_parent

channel = open_parent(int(sys.argv[1]))
order = channel.wait(None)[0]
if text := order.get("log"):
    logging.getLogger("ibrobot.test").info(text)
for message in order.get("say", ()):
    channel.send(message)
if error := order.get("fail"):
    channel.report(Failure(error))
channel.flush(FAREWELL_S)
if number := order.get("signal"):
    os.kill(os.getpid(), number)
if order.get("linger"):
    while channel.wait(None):
        pass
os._exit(order.get("exit", 0))
