"""The page in a browser: an emulated headset and an emulated phone move an arm through it."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ibrobot_testing import host_context
from ibrobot_webxr.server import PageServer
from ibrobot_webxr.teleop import WebxrTeleop

from ibrobot_core.api import Header, Image, JointReading, RobotStatus, SteppedClock, Vector, ns

from .rig import ANY_PORT, BENT, page_of, robot_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(find_spec("playwright") is None, reason="needs playwright: pip install playwright"),
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
HEADSET = Path(__file__).parent / "emulated_headset.js"
# A page that a busy machine keeps from sending loses control; the person takes it again.
PERSON = """setInterval(() => {
  const claim = document.getElementById("claim");
  if (claim && !claim.hidden) claim.click();
}, 100)"""


class Arm:
    """An arm at the end of the teleop, followed in a thread.

    Its clock is slower than that of the browser, so that a busy machine makes no pose late.
    """

    def __init__(self, mjcf: Path) -> None:
        self.ctx = host_context("phone", robot=robot_of(mjcf), clock=SteppedClock(ns(1000.0)))
        self.teleop = WebxrTeleop(ANY_PORT, self.ctx)
        self.position = BENT.copy()
        self.moves = False
        self.stopped = False
        self.events: list[str] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def start(self) -> None:
        self.teleop.connect()
        self.teleop.activate(self.measured())
        self._thread.start()

    def end(self) -> None:
        self._end.set()
        self._thread.join()
        self.teleop.disconnect()

    def measured(self) -> JointReading:
        return JointReading(self.ctx.clock.now_ns(), self.position.copy(), np.zeros(6), np.zeros(6))

    def _run(self) -> None:
        while not self._end.wait(0.01):
            self.ctx.clock.sleep_until(self.ctx.clock.now_ns() + ns(0.002))
            command = self.teleop.read(self.measured())
            self.moves = command.positions is not None
            self.stopped |= command.estop
            self.events += command.events
            if command.positions is not None:
                self.position = np.array([command.positions[name] for name in self.ctx.robot.joint_names])

    def wait(self, until, act=lambda: None) -> None:
        """Act, again every two seconds since the page releases everything on a machine that is too busy."""
        for _ in range(15):
            act()
            deadline = time.monotonic() + 2
            while time.monotonic() < deadline:
                if until():
                    return
                time.sleep(0.01)
        raise AssertionError("nothing happened")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        yield browser
        browser.close()


@pytest.fixture
def arm(mjcf: Path) -> Iterator[Arm]:
    arm = Arm(mjcf)
    arm.start()
    yield arm
    arm.end()


@pytest.fixture
def server(arm: Arm) -> Iterator[PageServer]:
    with page_of(ANY_PORT, arm.ctx) as server:
        yield server


@pytest.fixture
def tab(chromium, server: PageServer) -> Iterator[Any]:
    """A phone's browser with the page open."""
    context = chromium.new_context(
        ignore_https_errors=True, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
    )
    asked: list[str] = []
    context.on("request", lambda request: asked.append(request.url))
    faults: list[str] = []
    tab = context.new_page()
    tab.add_init_script(PERSON)
    tab.on("pageerror", lambda error: faults.append(str(error)))
    tab.on("console", lambda message: faults.append(message.text) if message.type == "error" else None)
    yield tab
    origin = server.address.partition("/?")[0]
    assert [url for url in asked if not url.startswith((f"{origin}/", f"blob:{origin}"))] == []
    assert faults == []
    context.close()


def far(arm: Arm, start: Vector) -> bool:
    return bool(np.abs(arm.position - start).max() > 0.02)


def test_controllers_of_a_headset_move_the_arm(arm: Arm, server: PageServer, tab):
    sent: list[str] = []
    tab.on("websocket", lambda socket: socket.on("framesent", lambda text: sent.append(str(text))))
    tab.add_init_script(HEADSET.read_text())
    tab.goto(server.address)
    tab.get_by_role("button", name="Start VR").click()
    tab.locator("#link", has_text="Hz").wait_for()
    # A headset may have paused the page while VR started.
    arm.wait(lambda: tab.wait_for_timeout(10) or '{"type":"claim"}' in sent)
    tab.evaluate("emulated.right.position.z = -0.5")
    tab.wait_for_timeout(300)
    np.testing.assert_array_equal(arm.position, BENT)

    def press() -> None:
        tab.evaluate("emulated.right.squeeze = 0")
        tab.wait_for_timeout(200)
        tab.evaluate("emulated.right.squeeze = 1")

    arm.wait(lambda: arm.moves, press)
    np.testing.assert_allclose(arm.position, BENT, atol=1e-3)

    def push() -> None:
        tab.evaluate("emulated.right.trigger = 0")
        press()
        tab.wait_for_timeout(100)
        tab.evaluate("emulated.right.trigger = 1; emulated.right.position.z -= 0.05")

    arm.wait(lambda: far(arm, BENT) and arm.position[5] < 0, push)
    tab.evaluate("emulated.right.tracked = false")
    arm.wait(lambda: not arm.moves)

    def buttons() -> None:
        tab.evaluate("emulated.right.pressed = []; emulated.left.pressed = []")
        tab.wait_for_timeout(200)
        tab.evaluate("emulated.right.pressed = [4]; emulated.left.pressed = [5]")

    arm.wait(lambda: set(arm.events) == {"intervention", "start"}, buttons)
    tab.evaluate("emulated.left.pressed = [3]")
    arm.wait(lambda: arm.stopped)


def test_a_refused_pose_does_not_count_as_a_slow_network(server: PageServer, tab):
    tab.add_init_script(HEADSET.read_text())
    tab.goto(server.address)
    tab.get_by_role("button", name="Start VR").click()
    tab.locator("#link", has_text="Hz").wait_for()
    tab.evaluate("emulated.right.position.z = NaN")
    tab.get_by_text("position").wait_for()
    tab.evaluate("emulated.right.position.z = -0.3")
    tab.wait_for_timeout(800)  # the page reports the network each 250 ms, and counts 300 ms as slow
    tab.locator("#link", has_text="Hz").wait_for()


def test_a_tracked_hand_moves_the_arm_and_closes_its_gripper(arm: Arm, server: PageServer, tab):
    tab.add_init_script(HEADSET.read_text())
    tab.add_init_script("emulated.right.hand = { bent: false, pinched: false }")
    tab.goto(server.address)
    tab.get_by_role("button", name="Start VR").click()
    tab.locator("#link", has_text="Hz").wait_for()
    tab.evaluate("emulated.right.hand.pinched = true; emulated.right.position.z -= 0.1")
    tab.wait_for_timeout(300)
    np.testing.assert_array_equal(arm.position, BENT)

    def bend() -> None:
        tab.evaluate("Object.assign(emulated.right.hand, { bent: false, pinched: false })")
        tab.wait_for_timeout(200)
        tab.evaluate("emulated.right.hand.bent = true")
        tab.wait_for_timeout(100)
        tab.evaluate("emulated.right.hand.pinched = true; emulated.right.position.z -= 0.05")

    arm.wait(lambda: far(arm, BENT) and arm.position[5] < 0, bend)
    tab.evaluate("emulated.right.hand.bent = false")
    arm.wait(lambda: not arm.moves)


def test_a_phone_without_webxr_moves_the_arm_by_its_sensors_and_sticks(arm: Arm, server: PageServer, tab):
    tab.goto(server.address)
    sensors = tab.context.new_cdp_session(tab)
    turned = {"alpha": 10, "beta": 60, "gamma": 5}
    sensors.send("DeviceOrientation.setDeviceOrientationOverride", turned)
    tab.get_by_role("button", name="Use this phone").click()
    clutch, stick = (tab.locator(name).bounding_box() for name in ("#clutch", "#stick"))
    boxes = enumerate((clutch, stick))
    at = [{"id": i, "x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2} for i, box in boxes]

    touched: list[object] = []

    def touch(*points: dict[str, float]) -> None:
        if touched:
            sensors.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
            tab.wait_for_timeout(200)
        touched.append(points)
        sensors.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": at[: len(points)]})
        sensors.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": points})

    arm.wait(lambda: arm.moves, lambda: touch(at[0]))
    np.testing.assert_allclose(arm.position, BENT, atol=1e-3)

    def roll() -> None:
        touch(at[0])
        for gamma in range(6, 26):
            sensors.send("DeviceOrientation.setDeviceOrientationOverride", {**turned, "gamma": gamma})
            tab.wait_for_timeout(20)

    arm.wait(lambda: far(arm, BENT), roll)
    before = arm.position
    arm.wait(lambda: far(arm, before), lambda: touch(at[0], {**at[1], "y": at[1]["y"] - 80}))
    tab.evaluate("window.dispatchEvent(new Event('blur'))")  # e.g. a call comes in
    arm.wait(lambda: not arm.moves)
    tab.wait_for_timeout(100)  # poses on their way arrive
    held = arm.position
    tab.wait_for_timeout(200)
    np.testing.assert_array_equal(arm.position, held)


def test_the_page_shows_cameras_and_who_has_control(arm: Arm, server: PageServer, tab):
    bus = arm.ctx.bus
    assert bus is not None
    tab.goto(server.address)
    tab.locator("button[data-event]:enabled").first.wait_for(state="attached")  # it has control
    second = tab.context.new_page()
    second.goto(server.address)
    second.get_by_text("Another page has control").wait_for()
    pixels = np.full(48 * 64 * 3, 200, np.uint8)
    shown = tab.locator("figure img[src^=blob]")

    def comes() -> bool:
        bus.publish("/camera/wrist/image_raw", Image(Header(0), 48, 64, "rgb8", 192, pixels))
        tab.wait_for_timeout(50)
        return shown.count() > 0

    arm.wait(comes)
    shown.wait_for()
    tab.locator("figcaption", has_text="wrist").wait_for()
    bus.publish("/robot_status", RobotStatus(Header(0), "so101", "phone", faults=("<b>a fault</b>",)))
    tab.get_by_text("<b>a fault</b>").wait_for()
    tab.close()
    second.get_by_role("button", name="Take control").click()
    second.get_by_text("Another page has control").wait_for(state="detached")
    second.get_by_role("button", name="STOP").click()
    arm.wait(lambda: arm.stopped)
