"""The browser of this machine's desktop."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser


def open_browser(url: str) -> None:
    """Open a page in a browser, without waiting, if the person who started the command has a desktop here."""
    if "SSH_CONNECTION" in os.environ or "CI" in os.environ:
        return
    if sys.platform == "darwin" or {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        threading.Thread(target=webbrowser.open, args=(url,), name="browser", daemon=True).start()
