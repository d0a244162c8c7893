"""The page in headless Chromium: an operator's clicks and keys, a watcher, and what they see."""

from __future__ import annotations

import io
import math
import shutil
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from ibrobot_terminal.panel import Joints
from ibrobot_terminal.screen import Screen

from ibrobot_core.app import installed_plugins

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]
WAIT_S = 120.0
PATIENT = ("--set", "control.peer_timeout=5")
"""A busy machine may hold up a run for longer than the 0.3 s after which the robot is stopped."""
PRESS_S = 2.0
"""Time after which a press that moves nothing counts as ended [s]."""
REST_NS = 300_000_000
STATE = """JSON.stringify({
    operating: ibrobot.operating, held: ibrobot.deadman.held, faults: ibrobot.status?.faults, state: ibrobot.state,
    unconfirmed: ibrobot.unconfirmed, toasts: document.querySelector(".toasts")?.innerText,
})"""


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    from page_run import page_run

    with page_run("so101_blind", "--sim", "--mode", "web", *PATIENT) as found:
        yield found


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


ALPHAS = """(() => {
    const view = document.querySelector('#view canvas'), copy = document.createElement('canvas');
    Object.assign(copy, { width: view.width, height: view.height });
    const context = copy.getContext('2d');
    context.drawImage(view, 0, 0);
    const alphas = context.getImageData(0, 0, copy.width, copy.height).data.filter((_, i) => i % 4 === 3);
    return [Math.min(...new Set(alphas)), Math.max(...new Set(alphas))];
})()"""
"""The least and the greatest opacity of what is drawn of the robot."""


class Tab:
    """A page in a browser of its own; its errors are collected."""

    def __init__(self, chromium: Any, address: str, **context: Any) -> None:
        # Software draws the 3D: a sixteenth of the pixels, in the same layout.
        drawn = {"viewport": {"width": 1020, "height": 700}, "device_scale_factor": 0.25}
        self._context = chromium.new_context(**{**drawn, **context})
        self.page = self._context.new_page()
        self.errors: list[str] = []
        self.hosts: set[str] = set()
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda line: self.errors.extend([line.text] * (line.type == "error")))
        self.page.on("request", lambda request: self.hosts.add(request.url.split("/")[2]))
        self.page.goto(address)
        self.until(lambda: self.ask("ibrobot.status !== null && ibrobot.state !== null"))

    def ask(self, expression: str) -> Any:
        return self.page.evaluate(expression)

    def until(self, met: Callable[[], Any]) -> None:
        deadline_s = time.monotonic() + WAIT_S
        while not met():
            assert time.monotonic() < deadline_s, f"still not; errors of the page: {self.errors}; {self.ask(STATE)}"
            self.page.wait_for_timeout(50)

    def hold(self, press: Callable[[], None], release: Callable[[], None], met: Callable[[], Any]) -> None:
        """Press, and again after a while, until a condition is met: a stall of the page or of the run ends a press."""
        press_s = -math.inf

        def moves() -> bool:
            nonlocal press_s
            if met():
                return True
            if time.monotonic() > press_s + PRESS_S:
                release()
                press()
                press_s = time.monotonic()
            return False

        self.until(moves)

    def position(self, joint: int) -> float:
        return float(self.ask(f"ibrobot.state.position[{joint}]"))

    def rests_at(self, joint: int) -> float:
        """Wait until a joint keeps its position for a while of the robot's time; return it [rad]."""
        since_ns, position = 0, math.inf

        def rests() -> bool:
            nonlocal since_ns, position
            state = self.ask("ibrobot.state")
            if abs(state["position"][joint] - position) > 0.01:
                since_ns, position = state["stamp"], state["position"][joint]
            return bool(state["stamp"] > since_ns + REST_NS)

        self.until(rests)
        return position

    def draws(self) -> None:
        """Wait until the robot is drawn as it is from now on."""
        drawn = self.ask("ibrobot.view.frames")
        self.until(lambda: self.ask("ibrobot.view.frames") > drawn + 2)

    def enter(self, what: str, mode: str) -> None:
        """Choose a mode by what it does."""
        self.page.locator("#mode summary").click()
        self.page.get_by_role("group", name="Modes").get_by_role("button", name=what).click()
        self.until(lambda: self.ask(f"ibrobot.status.mode === '{mode}'"))

    def text(self, selector: str) -> str:
        return str(self.page.locator(selector).inner_text())

    def close(self) -> None:
        assert not self.errors
        self._context.close()


@pytest.fixture
def tab(chromium: Any, address: str) -> Iterator[Tab]:
    found = Tab(chromium, address)
    yield found
    found.close()


def test_the_page_shows_the_robot_and_asks_no_other_host(tab: Tab, address: str) -> None:
    tab.until(lambda: tab.ask("ibrobot.view.frames") > 2)
    assert tab.text("#robot") == "so101"
    assert tab.ask("document.querySelector('#view .note').textContent") == "", "3D has a problem"
    assert tab.ask(ALPHAS) == [0, 255], "the theme's background shows around the robot, before anything is drawn again"
    assert tab.page.locator(".joint").count() == 6
    assert tab.page.locator(".joint output").first.inner_text().endswith(" rad"), "as the panel in the terminal"
    tab.page.get_by_role("button", name="in radians").click()
    tab.until(lambda: tab.page.locator(".joint output").first.inner_text().endswith("°"))
    for name in ("Plots", "Health", "Log"):
        toggle = tab.page.get_by_role("button", name=name, exact=True)
        toggle.click()
        assert tab.page.get_by_role("region", name=name, exact=True).is_visible()
        assert tab.page.locator("#panels > :visible").count() == 1
        toggle.click()
        assert tab.page.locator("#panels > :visible").count() == 0
    assert tab.hosts == {address.split("/")[2]}


MINUS = "\N{MINUS SIGN}"
JOINTS = """async ([joints, slides, position, unit]) => {
  const { Joints } = await import("/static/joints.js");
  const { deadman } = window.ibrobot, section = document.createElement("section");
  localStorage.setItem("angles", unit);
  const shown = new Joints(section, { deadman, view: { slides }, jogs: [], mode: null, device: null });
  shown.update({ robot: { joints } });
  shown.state({ position, command: position });
  localStorage.removeItem("angles");
  return [...section.querySelectorAll("output")].map((each) => each.textContent);
}"""
"""The positions of joints on the page, in a unit that was chosen in this browser before."""


def test_joints_have_the_numbers_of_the_panel_in_the_terminal(tab: Tab) -> None:
    names, position = ("arm", "wrist", "grip", "rail"), (-1.23456, -0.0001, 0.03456, 0.7004)
    upper = (3.0, 2.0, 0.8, 0.9)
    joints = [
        SimpleNamespace(name=name, lower=-0.05, upper=most) for name, most in zip(names, upper, strict=True)
    ]  # fmt: skip
    state = SimpleNamespace(position=np.array(position), command=np.array(position))
    session: Any = SimpleNamespace(state=state, config=SimpleNamespace(robot=SimpleNamespace(joints=joints)))
    drawn = io.StringIO()
    Screen(file=drawn, width=50).print(Joints(cast("Any", SimpleNamespace(session=session))))
    heading, *rows = drawn.getvalue().splitlines()
    assert heading == "joints [rad, or m where they slide]"
    panel = {name: shown.removeprefix("+") for name, shown in (row.split()[:2] for row in rows)}
    assert panel == {"arm": "-1.23", "wrist": "0.00", "grip": "0.035", "rail": "0.700"}

    def page(unit: str) -> list[str]:
        shown = tab.page.evaluate(JOINTS, [[vars(each) for each in joints], ["rail"], position, unit])
        return [each.replace(MINUS, "-") for each in shown]

    assert page("rad") == [f"{panel[name]} {'m' if name == 'rail' else 'rad'}" for name in names]
    assert page("deg") == ["-71°", "0°", "2°", "700 mm"], "the choice of a browser"


def test_a_held_button_moves_a_joint_and_leaving_the_page_stops_it(tab: Tab) -> None:
    tab.until(lambda: tab.ask("ibrobot.jogs.length > 0"))
    before = tab.position(0)
    up = tab.page.get_by_label("shoulder_pan up, hold to move")
    up.hover()
    mouse = tab.page.mouse
    tab.hold(mouse.down, mouse.up, lambda: tab.position(0) > before + 0.1)
    tab.ask("window.dispatchEvent(new Event('blur'))")
    assert tab.ask("ibrobot.deadman.held") is False
    rest = tab.rests_at(0)
    assert rest < 1.5, "it does not go on to its limit"
    mouse.up()
    tab.page.get_by_label("shoulder_pan down, hold to move").focus()
    keyboard = tab.page.keyboard
    tab.hold(lambda: keyboard.down("Enter"), lambda: keyboard.up("Enter"), lambda: tab.position(0) < rest - 0.05)
    keyboard.up("Enter")
    assert tab.ask("ibrobot.deadman.held") is False


WARNED = """async () => (await import("/static/dom.js")).toast("the connection is too slow to jog", "error")"""


def test_escape_stops_the_robot_whatever_the_page_shows_and_wherever_the_focus_is(tab: Tab) -> None:
    assert tab.text("#stop") == "STOP Esc"
    for place in ("#view canvas", ".joint input", "#prompt", "dialog button", "mode"):
        tab.until(lambda: tab.ask("!ibrobot.state.estop && Boolean(ibrobot.operating)"))
        if place == "mode":
            tab.enter("plan motions", "moveit_planning")
            tab.page.locator("#goal").focus()
        elif place == "dialog button":
            tab.page.get_by_role("button", name="End the run").click()
        elif place == "#prompt":
            tab.ask(
                "document.body.append(Object.assign(document.createElement('input'), {id: 'prompt', type: 'text'}))"
            )
        if place != "mode":
            tab.page.locator(place).first.focus()
        tab.page.evaluate(WARNED)
        assert "too slow" in tab.text(".toasts")
        tab.page.keyboard.press("Escape")
        tab.until(lambda: tab.ask("ibrobot.state.estop && ibrobot.status.faults.length > 0"))
        assert "emergency stop" in tab.text("#faults")
        assert "too slow" not in tab.text(".toasts"), "a message that is past does not cover the fault on a phone"
        tab.ask("document.getElementById('dialog').close()")
        tab.page.locator("#faults button").first.click()
        tab.until(lambda: tab.ask("!ibrobot.state.estop"))
        assert tab.text("#stop") == "STOP Esc"
    tab.enter("drive from the page", "web")


def test_escape_stops_the_robot_before_the_page_knows_who_uses_it(chromium: Any, address: str, tab: Tab) -> None:
    tab.until(lambda: tab.ask("Boolean(ibrobot.operating)"))
    tab.page.add_init_script("window.fetch = () => new Promise(() => {})")
    tab.page.route_web_socket("**/drive", lambda socket: None)
    tab.page.reload()
    tab.until(lambda: tab.ask("ibrobot.state !== null && ibrobot.line.socket.readyState === WebSocket.OPEN"))
    tab.page.keyboard.press("Escape")
    tab.until(lambda: tab.ask("ibrobot.state.estop"))
    other = Tab(chromium, address)
    other.until(lambda: other.ask("Boolean(ibrobot.operating)"))
    other.page.get_by_role("button", name="Reset").first.click()
    other.until(lambda: other.ask("!ibrobot.state.estop"))
    other.close()


def test_dragging_the_ball_moves_the_tool_until_the_page_is_left(tab: Tab) -> None:
    tab.until(lambda: tab.ask("ibrobot.jogs.length > 0"))
    mouse = tab.page.mouse
    tab.page.get_by_role("button", name="home").hover()
    tab.hold(mouse.down, mouse.up, lambda: abs(tab.position(1)) < 0.02 and abs(tab.position(2)) < 0.02)
    mouse.up()
    tab.ask("window.scrollTo(0, 0)")
    before = [tab.rests_at(joint) for joint in range(5)]

    def drag() -> None:
        tab.draws()
        x, y = tab.ask("ibrobot.view.handle()")
        assert 60 < y < 700, "the ball is on the screen"
        mouse.move(x, y)
        mouse.down()
        mouse.move(x, y - 40, steps=4)

    tab.hold(drag, mouse.up, lambda: max(abs(tab.position(joint) - before[joint]) for joint in range(5)) > 0.1)
    tab.ask("window.dispatchEvent(new Event('blur'))")
    tab.draws()
    assert tab.ask("ibrobot.deadman.held") is False, "the same press does not go on"
    mouse.up()


def test_an_arm_that_stands_upright_is_in_sight_as_a_whole(tab: Tab) -> None:
    for top, target, distance in ((0.3, [0, 0, 0], 2.0), (1.2, [0, 0, 0.6], 2.0), (3.0, [0, 0, 1.5], 1.2 * 1.5 / 0.4)):
        points = [[0, 0, 0], [0, 0, top]]
        framed = tab.ask(f"import('./static/matrix.js').then((all) => all.framed({points}, [0, 0, 0], 2, 0.4))")
        assert framed == {"target": target, "distance": pytest.approx(distance)}


def test_one_operates_the_other_watches_and_takes_over(chromium: Any, address: str, tab: Tab) -> None:
    tab.until(lambda: tab.ask("ibrobot.operating"))
    other = Tab(chromium, address, viewport={"width": 390, "height": 844})
    try:
        assert "watching" in other.text("#operator")
        assert other.page.locator("#thumb").is_hidden()
        tab.enter("plan motions", "moveit_planning")
        other.until(lambda: other.ask("ibrobot.status.mode") == "moveit_planning")
        other.until(lambda: "Only the page that operates can jog." in other.text("#motion"))
        tab.enter("drive from the page", "web")
        other.until(lambda: other.ask("ibrobot.status.mode") == "web")
        assert other.page.get_by_role("button", name="End the run", exact=True).is_disabled()
        assert other.page.locator(".joint .jog:visible, .joint :enabled, #motion button, #mode :enabled").count() == 0
        other.page.get_by_role("button", name="Take over").click()
        other.until(lambda: other.ask("ibrobot.operating"))
        tab.until(lambda: not tab.ask("ibrobot.operating"))
        assert "operates" in tab.text("#operator")
        jog = "ibrobot.drive.call('call', {service: '/set_mode', request: 'jog'})"
        late = tab.ask(f"{jog}.then(() => 'done', (error) => error.message)")
        assert "take over first" in late
        assert other.ask("ibrobot.status.mode") == "web"
        other.until(lambda: other.page.locator("#thumb").is_visible())
        assert other.ask("document.documentElement.scrollWidth") <= 390
        box = other.page.locator("#stop").bounding_box()
        other.page.mouse.wheel(0, 900)
        other.page.wait_for_timeout(200)
        assert other.page.locator("#stop").bounding_box() == box, "the stop stays on top"
    finally:
        other.close()


def test_a_goal_is_previewed_before_it_is_executed(tab: Tab) -> None:
    tab.until(lambda: tab.ask("ibrobot.operating"))
    tab.enter("plan motions", "moveit_planning")
    tab.until(lambda: tab.page.locator("#goal").is_visible())
    before = tab.position(1)
    tab.ask("window.scrollTo(0, 0)")
    tab.until(lambda: tab.ask("ibrobot.view.frames") > 2)
    x, y = tab.ask("ibrobot.view.handle()")
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x, y - 30, steps=4)
    tab.page.mouse.up()
    tab.until(lambda: tab.page.locator("#goal").input_value().startswith("xyz="))
    tab.until(lambda: "path" in tab.text(".toasts"))
    tab.ask("document.querySelector('.toasts').replaceChildren()")
    tab.page.get_by_role("button", name="rest", exact=True).click()
    tab.until(lambda: "The path takes" in tab.text(".toasts"))
    assert abs(tab.position(1) - before) < 0.02
    tab.page.get_by_role("button", name="Go", exact=True).click()
    tab.until(lambda: abs(tab.position(1) + 1.57) < 0.05)
    tab.enter("drive from the page", "web")
