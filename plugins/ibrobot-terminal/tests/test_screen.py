"""Tables and panels show text from outside as it is: no markup, and no control characters."""

from __future__ import annotations

import io
import re

from hypothesis import given
from hypothesis import strategies as st
from ibrobot_terminal.screen import Screen, styled
from rich.table import Table

HOSTILE = st.lists(
    st.sampled_from(
        ["[/x]", "[red]", "[link=http://x]", ":warning:", "\x1b[2J", "\x1b]0;x\x07", "\x9b", "\r", "\u202e", "\u061c"]
    )
    | st.text(max_size=5),
    max_size=8,
).map("".join)
UNPRINTABLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u202a-\u202e\ud800-\udfff]")


def rendered(*shown: object) -> str:
    screen = Screen(file=io.StringIO(), width=1000)
    for each in shown:
        screen.print(each)
    assert isinstance(screen.file, io.StringIO)
    return screen.file.getvalue()


@given(HOSTILE)
def test_a_table_shows_markup_as_it_is(hostile: str):
    table = Table(title=hostile)
    table.add_column(hostile)
    table.add_row(hostile)
    table.add_row(styled(hostile, "red"))
    shown = rendered(table, hostile, styled(hostile))
    assert not UNPRINTABLE.search(shown)
    assert shown.count("[/x]") >= hostile.count("[/x]")


def test_markup_is_shown_literally():
    table = Table(title="[b]title[/x]")
    table.add_row("[/x] :warning:")
    shown = rendered(table, "[red]plain", styled("[red]styled"))
    assert all(each in shown for each in ("[b]title[/x]", "[/x] :warning:", "[red]plain", "[red]styled"))
