"""The command `ibrobot` in this process, which has imported by then what each child would import again."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from subprocess import CompletedProcess
from unittest.mock import patch

from ibrobot_core.cli.main import main


def run_here(*arguments: object) -> CompletedProcess[str]:
    """Run `ibrobot` with arguments, to its end; its exit code and what it printed."""
    out, err = io.StringIO(), io.StringIO()
    command = ["ibrobot", *map(str, arguments)]
    code: object = None
    with patch.object(sys, "argv", command), redirect_stdout(out), redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code
    assert code is None or isinstance(code, int)
    return CompletedProcess(command, code or 0, out.getvalue(), err.getvalue())
