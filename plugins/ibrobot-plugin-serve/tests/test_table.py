"""What robots call themselves is shown as text."""

from __future__ import annotations

import io
import re

from hypothesis import given
from hypothesis import strategies as st
from ibrobot_serve.command import _table
from ibrobot_terminal.screen import Screen

HOSTILE = st.lists(
    st.sampled_from(
        ["[/x]", "[red]", "[link=http://x]", ":warning:", "\x1b[2J", "\x1b]0;x\x07", "\x9b", "\r", "\u202e"]
    )
    | st.text(max_size=5),
    max_size=8,
).map("".join)
UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\ud800-\udfff]")


@given(st.dictionaries(HOSTILE, st.just(None), max_size=3), HOSTILE)
def test_the_server_s_table_takes_any_robot_s_name(robots: dict[str, None], model: str):
    """A robot that called itself [/x] ended the server of all."""
    counts: dict[str, float] = dict.fromkeys(("requests", "answered", "expired", "malformed", "waiting", "failed"), 0)
    counts |= dict.fromkeys(("latency_p50_ms", "latency_p99_ms"), 0.0)
    statistics = {**counts, "model": model, "robots": dict.fromkeys(robots, counts)}
    screen = Screen(file=io.StringIO(), width=1000)
    screen.print(_table(statistics))
    assert isinstance(screen.file, io.StringIO)
    assert not UNPRINTABLE.search(screen.file.getvalue())
