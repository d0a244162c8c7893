"""QR codes in a terminal."""

from __future__ import annotations

import segno

_BORDER = 2
_CELLS = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}
"""(upper, lower) module is dark -> character, for light text on a dark terminal; phones read inverted codes, too."""


def qr_code(text: str) -> str:
    """A QR code as lines of half blocks, two rows of modules a line."""
    rows = [[bool(module) for module in row] for row in segno.make(text, error="l").matrix_iter(border=_BORDER)]
    if len(rows) % 2:
        rows.append([False] * len(rows[0]))
    return "\n".join(
        "".join(_CELLS[pair] for pair in zip(upper, lower, strict=True))
        for upper, lower in zip(rows[::2], rows[1::2], strict=True)
    )
