"""Child processes: what they say, their log, their end, and the cause of their death."""

from __future__ import annotations

import io
import json
import logging
import os
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from ibrobot_core.child import Child
from ibrobot_core.errors import ComponentFailed

PATIENCE_S = 30.0
SHARED = Path(__file__).parent / "shared"


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Child]]:
    """Starts `tests/shared/obedient_child.py`, which does what the order says."""
    monkeypatch.chdir(SHARED)
    children: list[Child] = []

    def start_child(end_s: float = PATIENCE_S, output: io.BufferedRandom | None = None, **order: Any) -> Child:
        children.append(Child("obedient_child", order, end_s=end_s, stdout=output, stderr=output))
        return children[-1]

    yield start_child
    for child in children:
        with suppress(ProcessLookupError):
            os.killpg(child.pid, signal.SIGKILL)  # with what it has forked
        child.end()
        child.channel.close()


def listen(child: Child) -> None:
    """Until it is gone."""
    while True:
        child.wait(PATIENCE_S)


class TestChild:
    def test_messages_come_back_and_log_records_go_to_the_log_of_the_parent(self, start, caplog):
        child = start(log="the arm is warm", say=[{"event": "ready"}, {"event": "report"}])
        with caplog.at_level(logging.INFO, "ibrobot"):
            first, second = child.wait(PATIENCE_S), child.wait(PATIENCE_S)

        assert (first, second) == ({"event": "ready"}, {"event": "report"})
        assert caplog.messages == ["the arm is warm"]

    def test_words_of_the_protocol_in_messages_are_only_words(self, start, caplog):
        """With messages and reports in one envelope, the first raised and the second was the child's failure."""
        forged = [
            {"do": "release", "event": "log"},
            {"event": "log", "logger": "ibrobot.web", "level": 40, "message": "forged"},
            {"do": "estop", "event": "failed", "error": "forged"},
            {"failure": {"error": "forged"}},
        ]
        child = start(say=forged)
        with caplog.at_level(logging.INFO, "ibrobot"):
            received = [child.wait(PATIENCE_S) for _ in forged]
            with pytest.raises(ComponentFailed, match="exit status 0"):
                listen(child)

        assert received == forged
        assert caplog.messages == []
        assert child.failure is None

    @pytest.mark.parametrize(
        ("order", "cause"),
        [
            ({"exit": 3}, "exit status 3"),
            ({}, "exit status 0"),
            ({"fail": "no servo 3"}, "no servo 3"),
            ({"signal": 9}, "killed by SIGKILL"),
            ({"signal": 9, "forks": True}, "killed by SIGKILL"),
        ],
    )
    def test_the_cause_of_a_death_is_in_its_own_words_or_in_those_of_the_system(self, start, order, cause):
        child = start(say=[{"event": "ready"}], **order)
        assert child.wait(PATIENCE_S) == {"event": "ready"}
        with pytest.raises(ComponentFailed, match=f"^{cause}$"):
            listen(child)

        assert child.cause() == cause
        assert not child.end()

    def test_what_it_said_before_its_failure_is_heard_first(self, start):
        child = start(say=[{"number": 1}, {"number": 2}], fail="no servo 3")
        assert [child.wait(PATIENCE_S), child.wait(PATIENCE_S)] == [{"number": 1}, {"number": 2}]
        with pytest.raises(ComponentFailed, match="no servo 3"):
            child.wait(PATIENCE_S)

    def test_a_failure_is_raised_at_once_though_the_end_takes_long(self, start):
        text = b'["failure", {"error": "no servo 3"}]'
        child = start(end_s=0.0, raw=(struct.pack("<II", len(text), 0) + text).hex(), linger=60.0)
        with pytest.raises(ComponentFailed, match="no servo 3"):
            child.wait(PATIENCE_S)
        assert child.alive

    def test_what_it_said_before_its_death_is_heard_also_behind_a_log_record(self, start):
        child = start(log="one", say=[{"number": 1}], exit=3)
        child.end()
        assert child.wait(PATIENCE_S) == {"number": 1}
        with pytest.raises(ComponentFailed, match="exit status 3"):
            child.wait(PATIENCE_S)

    def test_one_that_never_gets_ready_is_killed_at_the_end(self, start):
        child = start(end_s=0.0, linger=60.0)
        assert child.wait(0.0) is None
        assert child.wait(0.05) is None
        child.channel.close()

        assert child.end()
        assert child.cause() == "killed by SIGKILL"

    def test_bytes_come_with_messages_both_ways(self, start):
        child = start(linger=0.0, bytes=3_000_000)
        message = child.wait(PATIENCE_S)
        assert message is not None
        assert bytes(message.payload) == bytes(range(256)) * (3_000_000 // 256)
        child.channel.send({"do": "echo"}, message.payload)
        assert (answer := child.wait(PATIENCE_S)) is not None
        assert answer.payload == message.payload

    @pytest.mark.parametrize(("do", "cause"), [("die", "exit status 7"), ("hang", "killed by SIGKILL")])
    def test_one_that_does_not_answer_has_died_or_hangs(self, start, do, cause):
        child = start(end_s=0.0 if do == "hang" else PATIENCE_S, linger=0.0)
        child.channel.send({"do": do})
        if do == "hang":
            child.channel.send({"do": "echo"})
            assert child.wait(0.1) is None
            assert child.alive
        else:
            with pytest.raises(ComponentFailed, match=cause):
                child.wait(PATIENCE_S)
        assert child.cause() == cause

    @pytest.mark.parametrize(
        ("raw", "dropped"),
        [
            (struct.pack("<II", 5, 0) + b"wrong", 1),
            (struct.pack("<II", 5, 3) + b"wrong\0\0\0", 1),
            (struct.pack("<II", 1 << 31, 0), 0),
            (struct.pack("<II", 5, 1 << 31), 0),
            (b"Traceback (most recent call last):\n", 0),
        ],
    )
    def test_a_damaged_frame_is_dropped_or_ends_it(self, start, caplog, raw, dropped):
        child = start(end_s=0.0 if not dropped else PATIENCE_S, raw=raw.hex(), linger=60.0 if not dropped else 0.0)
        if dropped:
            child.channel.send({"do": "echo"})
            assert child.wait(PATIENCE_S) == {"event": "answer", "do": "echo"}
            assert "sent what is no message; it was dropped" in caplog.text
        else:
            with pytest.raises(ComponentFailed, match="killed by SIGKILL"):
                listen(child)
        assert child.channel.dropped == dropped

    @pytest.mark.parametrize(
        ("word", "wrong"),
        [
            ("log", {"logger": "ibrobot.web", "level": 20}),
            ("log", {"logger": "root", "level": 20, "message": "forged"}),
            ("log", {"logger": "ibrobot.a\nb", "level": 20, "message": "forged"}),
            ("log", {"logger": "ibrobot.web", "level": "20", "message": "forged"}),
            ("log", {"logger": "ibrobot.web", "level": 20, "message": ["forged"]}),
            ("log", {"logger": "ibrobot.web", "level": 20, "message": "forged", "more": 1}),
            ("failure", {"error": 5}),
            ("failure", {"error": "forged", "exit_code": 256}),
            ("failure", {"error": "forged", "holding": [1]}),
            ("order", {"host": 1}),
        ],
    )
    def test_a_report_has_known_keys_of_their_types(self, start, caplog, word, wrong):
        text = json.dumps([word, wrong]).encode()
        child = start(raw=(struct.pack("<II", len(text), 0) + text).hex(), linger=0.0)
        child.channel.send({"do": "echo"})
        assert child.wait(PATIENCE_S) == {"event": "answer", "do": "echo"}
        assert child.channel.dropped == 1
        assert child.failure is None
        assert "forged" not in caplog.text

    def test_a_flood_of_output_holds_nothing_up(self, start):
        with tempfile.TemporaryFile() as output:
            child = start(output=output, floods=200, prints="no rclpy", say=[{"event": "ready"}])
            assert child.wait(PATIENCE_S) == {"event": "ready"}
            child.end()
            assert output.seek(0, os.SEEK_END) > 10_000_000
            output.seek(0)
            assert output.read(20).startswith(b"no rclpy")

    def test_it_ends_when_its_parent_is_killed(self, tmp_path):
        code = (
            "import sys, time\n"
            "from ibrobot_core.child import Child\n"
            "child = Child('obedient_child', {'linger': 0.0, 'say': [{'event': 'ready'}]}, end_s=1.0)\n"
            "child.wait(30.0)\n"
            "print(child.pid, flush=True)\n"
            "time.sleep(60.0)\n"
        )
        parent = subprocess.Popen([sys.executable, "-c", code], cwd=SHARED, stdout=subprocess.PIPE)
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        handle = os.pidfd_open(pid)
        parent.kill()
        parent.wait()
        parent.stdout.close()
        import select

        assert select.select([handle], [], [], PATIENCE_S)[0], "it goes on without its parent"
        os.close(handle)
