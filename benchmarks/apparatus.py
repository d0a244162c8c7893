"""What benchmarks share: their last line of figures, runs in real time, and processes beside this one.

What is imported only in functions need not be installed: LeRobot's interpreter runs `lerobot_async.py`, too.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ibrobot_core.app import Runtime
    from ibrobot_core.interfaces import Transport

ROOT = Path(__file__).parents[1]
CONFIGS = ROOT / "configs"
PREFIX = "figures: "
sys.path.append(str(ROOT / "tests/shared"))


def report(**figures: float) -> None:
    """Print the figures of a benchmark, rounded to four digits."""
    print(PREFIX + json.dumps({name: float(f"{value:.4g}") for name, value in figures.items()}), flush=True)


def reported(output: str) -> dict[str, float]:
    """The figures in what a benchmark printed; empty if there are none."""
    lines = [line for line in output.splitlines() if line.startswith(PREFIX)]
    figures: dict[str, float] = json.loads(lines[-1].removeprefix(PREFIX)) if lines else {}
    return figures


def in_rounds(count: int, what: str = "round") -> Iterator[int]:
    """The numbers of rounds, from 0; a line on standard error after each, since they take minutes."""
    for number in range(count):
        yield number
        print(f"{what} {number + 1} of {count}", file=sys.stderr, flush=True)


def cpu_s(pid: int | str = "self") -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def ibrobot(*words: object, good: Collection[int] = (0,)) -> str:
    """Run a command of this environment, and return what it printed."""
    print(f"$ ibrobot {' '.join(map(str, words))}", file=sys.stderr, flush=True)
    program = Path(sys.executable).with_name("ibrobot")
    done = subprocess.run([program, *map(str, words)], stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in good:
        raise SystemExit(f"ibrobot {words[0]} ended with {done.returncode}")
    return done.stdout


def in_a_process(file: str, *words: object) -> dict[str, Any]:
    """What a program of Python printed last, as JSON."""
    ran = subprocess.run([sys.executable, file, *map(str, words)], stdout=subprocess.PIPE, text=True, check=True)
    result: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return result


@contextmanager
def started(*command: object, says: str = "") -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process of Python, and the line that shows that it is ready; killed at the end.

    Args:
        command: the file, and its options.
        says: what the line has in it; the first one counts when left out.
    """
    words = [sys.executable, *map(str, command)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            line = next((line for line in process.stdout if says in line), "")
            if not line:
                raise SystemExit(f"{' '.join(words)} did not start")
            yield process, line.strip()
        finally:
            process.kill()


@contextmanager
def running(config: Any, registry: Any = None, **asked: Any) -> Iterator[Runtime]:
    """A run of a robot that has begun, as `ibrobot launch` makes it; stopped at the end.

    Args:
        config: the robot.
        registry: plugins other than the installed ones.
        asked: fields of the request to launch.
    """
    from ibrobot_core.app import LaunchRequest, Runtime, Session, installed_plugins

    runtime = Runtime(Session(config, registry or installed_plugins(), LaunchRequest(**asked)))
    runtime.start()
    try:
        yield runtime
    finally:
        runtime.stop()
    runtime.raise_failure()


def ended(runtime: Runtime) -> dict[str, Any]:
    """Wait for the end of a run in real time; its summary."""
    while not runtime.wait(0.2):
        pass
    return dict(runtime.summary())


def transport(**options: Any) -> Transport:
    """One of type zenoh."""
    from ibrobot_testing import host_context

    from ibrobot_core.app import installed_plugins

    descriptor = installed_plugins().find("transport", "zenoh")
    made: Transport = descriptor.make(descriptor.options(**options), host_context())
    return made


@contextmanager
def plugin(name: str, source: str) -> Iterator[Path]:
    """Have a made-up plugin, found by this process and by those that it starts: its module in a folder, also given."""
    import pytest
    from ibrobot_testing.site import made_up_site

    with tempfile.TemporaryDirectory() as made, pytest.MonkeyPatch.context() as patches:
        (Path(made) / "source.py").write_text(source)
        with made_up_site(Path(made) / "site", Path(made), patches) as site:
            site.add(name, "source.py")
            yield Path(made)
