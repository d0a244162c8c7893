"""A node without ROS: an interpreter that does, instead of `run.py`, what a test says."""

from __future__ import annotations

import json
import os
import socket
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np

from ibrobot_core.app import Channel

type Frame = tuple[dict[str, Any], bytes]
HELLO = {
    "op": "hello",
    "python": "python",
    "rclpy": "rclpy",
    "distro": "jazzy",
    "rmw": "rmw_none",
    "domain": "0",
    "range": "LOCALHOST",
    "interfaces": ["std_srvs"],
}


def write(folder: Path, behaviour: str = "") -> Path:
    """An interpreter that is such a node; it notes every frame in `frames` beside it.

    Args:
        folder: where.
        behaviour: `missing`, `dies`: at the start; `silent`: does not answer pings; `controller STATE OFFSET COUNT`: a
            controller whose joints are where they are commanded to be, with a serialised JointState (hexadecimal), and
            where its positions are; otherwise what `sends` makes.
    """
    path = folder / "python"
    path.write_text(
        textwrap.dedent(f"""\
            #!{sys.executable}
            import runpy, sys
            sys.path.insert(0, {str(Path(__file__).parent)!r})
            runpy.run_path(sys.argv[1])["stub"](sys.argv[2])
            from fake_node import serve
            serve(int(sys.argv[3]), {behaviour!r}, {str(folder / "frames")!r})
            """)
    )
    path.chmod(0o755)
    return path


def sends(**answers: list[Frame]) -> str:
    """The behaviour that sends frames when the first frame of a kind comes, e.g. `subscriber` or `ping`."""
    return json.dumps({op: [[head, body.hex()] for head, body in frames] for op, frames in answers.items()})


def serve(descriptor: int, behaviour: str, notes: str) -> None:
    """The other side's program."""
    channel = Channel(socket.socket(fileno=descriptor))
    if behaviour == "dies":
        print("a library is missing", file=sys.stderr)
        os._exit(3)
    if behaviour.startswith("controller"):
        _control(channel, *behaviour.split()[1:])
    answers = json.loads(behaviour) if behaviour.startswith("{") else {}
    with open(notes, "a", encoding="utf-8") as noted:
        while not channel.closed:
            for head in channel.receive(0.1):
                noted.write(json.dumps([head, head.payload.hex()]) + "\n")
                noted.flush()
                if head["op"] == "order":
                    channel.send(
                        {"op": "missing", "what": "no rclpy", "python": "x"} if behaviour == "missing" else HELLO
                    )
                elif head["op"] == "ping" and behaviour != "silent":
                    channel.send({"op": "pong"})
                elif head["op"] == "end":
                    channel.flush(1.0)
                    os._exit(0)
                for answer, body in answers.pop(head["op"], ()):
                    channel.send(answer, bytes.fromhex(body))
    os._exit(0)


def _control(channel: Channel, state: str, offset: str, count: str) -> None:
    """Publish states, and follow commands at 3 rad/s."""
    text, begin, size = bytearray.fromhex(state), int(offset), 8 * int(count)
    position = np.frombuffer(text, np.float64, int(count), begin).copy()
    command, told = position.copy(), False
    while not channel.closed:
        for head in channel.receive(0.002):
            if head["op"] == "order":
                channel.send(HELLO)
            elif head["op"] == "subscriber":
                told = True
                channel.send({"op": "matched", "topic": "", "subscribers": 1})
            elif head["op"] == "message":
                command = np.frombuffer(bytes(head.payload[-size:]))
            elif head["op"] == "end":
                os._exit(0)
        position += np.clip(command - position, -0.006, 0.006)
        text[begin : begin + size] = position.tobytes()
        if told:
            channel.send({"op": "message", "topic": "/joint_states"}, bytes(text))
    os._exit(0)


def frames(folder: Path) -> list[Frame]:
    """The frames that it has noted."""
    path = folder / "frames"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [(head, bytes.fromhex(body)) for head, body in map(json.loads, lines)]
