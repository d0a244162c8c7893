"""An agent in a process of its own, that asks for a long motion and answers pings: `piped_agent.py SOURCE SINK`.

It speaks the protocol by hand, so that it starts at once and nothing of it runs on when it is stopped.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any


def main() -> None:
    """Ask for a motion, and answer what the server asks."""
    source, sink = os.fdopen(int(sys.argv[1]), "rb"), int(sys.argv[2])

    def send(message: dict[str, Any]) -> None:
        os.write(sink, json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\n")

    info = {"protocolVersion": "2025-06-18", "capabilities": {}, "clientInfo": {"name": "piped", "version": "1"}}
    send({"id": 1, "method": "initialize", "params": info})
    for line in source:
        message = json.loads(line)
        if message.get("method") == "ping":  # with a number of the server's own
            send({"id": message["id"], "result": {}})
        elif message.get("id") == 1:
            send({"method": "notifications/initialized"})
            send({"id": 2, "method": "tools/list"})
        elif message.get("id") == 2:
            print("ready", flush=True)
            sys.stdin.readline()
            send({"id": 3, "method": "tools/call", "params": {"name": "go_to", "arguments": {"goal": sys.argv[3]}}})


if __name__ == "__main__":
    main()
