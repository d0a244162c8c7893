"""The panel on an emulated terminal: what matters is seen in full, however small the terminal."""

from __future__ import annotations

import io
import json
import logging
from typing import TYPE_CHECKING

import attrs
import pyte
import pytest
from ibrobot_terminal.panel import GuardBell, RecentLog, panel
from ibrobot_terminal.screen import Screen
from rich.live import Live

from ibrobot_core.api import String
from ibrobot_core.app import RunDisplay

if TYPE_CHECKING:
    from fake_runs import Runs

    from ibrobot_core.app import Runtime

SIZES = [(80, 24), (40, 24), (40, 12)]
FAULT = (
    "servo 3 (elbow_flex) does not answer: check its cable, then `ibrobot feetech scan --port /dev/ttyACM0`, which "
    "lists the servos that answer"
)
KEYS = "Esc emergency stop F10 reset Ctrl-C end"


class Drawn(RunDisplay):
    """A display that a test draws."""

    def show(self) -> None:
        """It is drawn by `Terminal`."""


@attrs.define
class Terminal:
    """The panel of a run, drawn by Rich and shown by a terminal emulator."""

    run: Runtime
    width: int
    height: int
    log: RecentLog = attrs.field(factory=RecentLog)
    help: str = ""
    more: tuple[tuple[str, str], ...] = ()
    display: Drawn = attrs.field(init=False)

    def __attrs_post_init__(self) -> None:
        self.display = Drawn(self.run.session)

    def lines(self, *messages: str, draws: int = 3) -> list[str]:
        """What is on the screen after some draws over one another."""
        for message in messages:
            self.log.emit(logging.makeLogRecord({"msg": message, "levelno": logging.INFO}))
        sent = io.StringIO()
        console = Screen(file=sent, width=self.width, height=self.height, force_terminal=True, color_system="standard")
        with Live(console=console, auto_refresh=False) as live:
            for _ in range(draws):
                self.run.step()
                self.display.sample()
                live.update(panel(self.display, self.log, self.help, self.more), refresh=True)
            drawn = sent.getvalue()  # before the display ends, which adds a line
        screen = pyte.Screen(self.width, self.height)
        pyte.Stream(screen).feed(drawn.replace("\n", "\r\n"))
        return [line.rstrip() for line in screen.display]

    def words(self, *messages: str) -> str:
        """What is on the screen, with its line breaks undone."""
        return " ".join(" ".join(self.lines(*messages)).split())


@pytest.fixture(params=SIZES, ids=lambda size: "x".join(map(str, size)))
def terminal(runs: Runs, request: pytest.FixtureRequest) -> Terminal:
    runtime = runs.start("contract.max_duration_s=100", mode="policy", seed=13)  # a scene that never succeeds
    for _ in range(5):  # the episode begins, and with it the generation
        runtime.step()
    return Terminal(runtime, *request.param)


def estop(run: Runtime) -> None:
    run.session.emergency_stop()
    for _ in range(20):
        run.step()


def test_a_message_may_come_while_the_panel_is_drawn(terminal: Terminal):
    class Interrupted:
        def __rich__(self) -> str:
            terminal.log.emit(logging.makeLogRecord({"msg": "late", "levelno": logging.INFO}))
            return "drawn"

    terminal.lines("first")
    terminal.log.lines.append(Interrupted())
    assert "drawn" in terminal.lines(draws=1)


def test_keys_come_first_and_nothing_scrolls_away(terminal: Terminal):
    lines = terminal.lines("a message")
    shown = " ".join(" ".join(lines).split())
    assert lines[0] == KEYS
    assert shown.index("a message") < shown.index("F1 policy")


def test_a_fault_is_shown_in_full_above_the_messages_and_the_mode_until_its_reset(terminal: Terminal):
    terminal.run.session.raise_fault(FAULT)
    for _ in range(20):
        terminal.run.step()
    shown = terminal.words("the newest message")
    assert f"FAULT: {FAULT}; F10 resets it" in shown
    assert shown.index(KEYS) < shown.index(FAULT) < shown.index("the newest message") < shown.index("F1 policy")
    terminal.run.reset()
    shown = terminal.words()
    assert FAULT not in shown
    assert "holding: press F1 to go on with policy" in shown
    terminal.run.switch_mode("policy")
    assert "holding" not in terminal.words()


RECORDING = (
    ("record", "prompt (Enter alone takes “pick the cube”, Tab goes back): pick the red cu_"),
    ("saved", "0 of 3 into episodes/default"),
    ("lost", "0 messages"),
    ("disk", "71338 MiB left at 1.5 MiB/s, 0.0 MiB queued"),
    ("topics", "/joint_states 100 Hz  /arm_position_controller/commands 100 Hz"),
)


def test_the_prompt_and_the_lines_of_a_recording_are_seen_in_every_terminal(terminal: Terminal):
    terminal.help = "Tab start, and end as success   F11 end as failure   F12 discard"
    terminal.more = RECORDING
    shown = terminal.words(*(f"message {i}" for i in range(9)))
    for heading, text in RECORDING[:4]:
        assert " ".join(f"{heading} {text}".split()) in shown


def test_help_on_a_device_is_not_shown_while_the_robot_holds(runs: Runs, monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal(runs.start(mode="teleop"), 120, 40, help="Tab start")
    monkeypatch.setattr(terminal.run.session.command_source, "help", lambda: "following the leader arm")
    assert "following the leader arm Tab start" in terminal.words()
    terminal.run.session.raise_fault(FAULT)
    for _ in range(20):
        terminal.run.step()
    shown = terminal.words()
    assert "following the leader arm" not in shown
    assert "Tab start" in shown


def test_an_emergency_stop_is_shown_with_its_key_until_its_reset(terminal: Terminal):
    estop(terminal.run)
    assert "EMERGENCY STOP: F10 resets it" in terminal.words()
    terminal.run.reset()
    assert "EMERGENCY STOP" not in terminal.words()
    estop(terminal.run)
    shown = terminal.words()
    assert "EMERGENCY STOP: F10 resets it" in shown, "also while the robot holds after a reset"
    assert "holding: press" not in shown


def test_a_fault_during_another_is_shown_too(terminal: Terminal):
    terminal.run.session.raise_fault("the first")
    terminal.run.step()
    terminal.run.session.add_fault("recording ended: the disk is full; make room")
    shown = terminal.words()
    assert "FAULT: recording ended: the disk is full; make room; F10 resets it FAULT: the first; F10" in shown


def test_the_newest_messages_are_whole_and_the_oldest_go_first(terminal: Terminal):
    shown = terminal.words(*(f"message {i} says {'much ' * 12}and ends with {i}." for i in range(6)))
    assert "message 5 says" in shown
    assert "and ends with 5." in shown
    assert "ends with 0." not in shown


def test_no_line_of_a_message_looks_like_a_row_of_the_panel(terminal: Terminal):
    lines = terminal.lines("step 1/2: a name\npath      up to 0.1 s\nagent     1:x asks for nothing")
    assert [each for each in lines if "up to 0.1 s" in each] == ["  path      up to 0.1 s"]
    assert not [each for each in lines if each.startswith(("path", "agent"))]


def test_a_wide_terminal_shows_all_facts(runs: Runs):
    shown = Terminal(runs.start(mode="policy"), 120, 40).words()
    for fact in (
        "sensors top",
        "plan ",
        "loop ",
        "episodes 0 done",
        "faults 0 now, 0 in this run",
        "joints [rad, or m where they slide]",
        "pan +0.",
        "target +0.",
        "grip",
    ):
        assert fact in shown, shown


APART = {"first": "hand", "second": "wall", "distance": 0.0031, "text": "hand was 3.1 mm from wall"}


def test_what_the_guard_keeps_apart_is_seen_until_it_lets_go(terminal: Terminal) -> None:
    bus = terminal.run.session.bus
    said = "the guard holds the arm back: hand was 3.1 mm from wall"
    bus.publish("/guard", String(json.dumps(APART)), latched=True)
    assert said in terminal.words()
    bus.publish("/guard", String(""), latched=True)
    assert "guard" not in terminal.words()


@pytest.mark.parametrize("label", ["something near", "[1]", "3", '{"first": "x"}', "{"])
def test_a_label_of_a_guard_that_is_no_json_is_seen_as_it_is(terminal: Terminal, label: str) -> None:
    terminal.run.session.bus.publish("/guard", String(label), latched=True)
    assert f"the guard holds the arm back: {label}" in terminal.words()


def test_the_bell_rings_once_for_each_thing_if_the_guard_asks_for_it() -> None:
    sent = io.StringIO()
    bell = GuardBell(Screen(file=sent, force_terminal=True))
    for text, sounds in (("a", True), ("a", True), ("b", True), ("c", False), ("", False), ("b", True)):
        bell.hear({"text": text, "sound": sounds} if text else {})
    assert sent.getvalue() == 3 * "\a"
