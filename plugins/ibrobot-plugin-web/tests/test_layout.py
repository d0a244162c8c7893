"""The layout of a run's page in headless Chromium, without a robot: what is in sight at each size."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from ibrobot_http.server import HttpServer
from ibrobot_terminal.agent_calls import AgentCalls
from ibrobot_testing import make_session
from ibrobot_web.link import FIRST_PICTURE, JPEG, PICTURE_HEAD, STATE, STATUS
from ibrobot_web.options import WebOptions
from ibrobot_web.pictures import to_picture
from ibrobot_web.server.app import make_app
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Answer, Drive
from ibrobot_web.server.page_guard import page_guard
from ibrobot_web.status import LogLines, status_json
from numpy.typing import NDArray

from ibrobot_core.api import Header, Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
OUT_OF_SIGHT = """(selectors) => selectors.flatMap((selector) => {
    const found = [...document.querySelectorAll(selector)].filter((each) => each.getClientRects().length);
    const hidden = found.filter((each) => {
        const {left, top, right, bottom, width, height} = each.getBoundingClientRect();
        const at = document.elementFromPoint(left + width / 2, top + height / 2);
        return left < 0 || top < 0 || right > innerWidth + 1 || bottom > innerHeight + 1 || !each.contains(at);
    });
    return found.length ? hidden.map((each) => `${selector}: ${each.textContent}`) : [`${selector}: is not there`];
})"""
"""Elements that are not inside the window, or that something covers, without scrolling."""
IN_SIGHT = ("#stop", "#view", "figure.picture", "#record button", "#mode summary")
"""What one looks at and what one does, at every size."""
SIZES: dict[tuple[int, int], tuple[str, ...]] = {
    (1280, 800): (".joint input", ".pad button", "#toggles button"),
    (1920, 1080): (".joint input", ".pad button", "#toggles button"),
    (390, 844): ("#thumb button", "#thumb select"),
}
"""Size of the window [px] -> what else is in sight: what moves the robot."""


COUNT_TONES = """() => {
    window.tones = 0;
    const start = OscillatorNode.prototype.start;
    OscillatorNode.prototype.start = function (...when) { window.tones += 1; start.apply(this, when); };
}"""
CUES = (("start", "1 of 10 saved", 1), ("ending", "1 of 10 saved", 3), ("saved", "1 of 10 saved", 6))
"""Cue of the run, what the page says, and how many tones it has played so far."""
EPISODE = {
    "recording": False, "by_mode": False, "saved": 1, "wanted": 10, "prompt": "pick the cube", "elapsed_s": 4.2,
    "max_duration_s": 20.0, "rates_hz": {}, "silent": [], "lost": {}, "free_bytes": 10**11, "bytes_per_s": 10**6,
    "failure": "", "waiting": False, "can_redo": True, "cues": 0, "cue": "",
}  # fmt: skip


def status(arms: tuple[str, ...] = ("",), **changes: Any) -> dict[str, Any]:
    """The status of a run that the page drives and records; with the prefixes of its arms."""
    session = make_session()
    found = status_json(session, LogLines(), AgentCalls(session), 1)
    joints = found["robot"]["joints"]
    found["robot"]["joints"] = [{**joint, "name": f"{arm}{joint['name']}"} for arm in arms for joint in joints]
    joints = [joint["name"] for joint in found["robot"]["joints"]]
    mode = {"planner": False, "policy": False, "unavailable": ""}
    modes = [
        {"name": "web", "label": "drive from the page", **mode, "jogs": {"page": joints}},
        {"name": "jog", "label": "drive by keys", **mode, "jogs": {}, "unavailable": "keyboard needs a terminal"},
        {"name": "run", "label": "run the policy pick", **mode, "jogs": {}, "policy": True},
    ]
    cameras = [
        {"channel": FIRST_PICTURE + i, "topic": f"/camera/{name}/image"} for i, name in enumerate(("top", "wrist"))
    ]
    robot = {**found["robot"], "modes": modes, "tool": True}
    facts = {"mode": "web", "jogs": ["page"], "cameras": cameras, "objects": [], "episode": EPISODE, "ended": False}
    facts["services"] = [*found["services"], "/record_episode/redo"]
    return {**found, "robot": robot, **facts, **changes}


class Run:
    """What a page takes for a run: it shows what it is told to."""

    def __init__(self) -> None:
        self.guard = page_guard(WebOptions(port=0), any_port="0")
        self.broadcast = Broadcast(lambda: None, frozenset({STATE, STATUS}))
        self.drive = Drive(self._carry_out, self._stop, lambda: None)
        self.refused = ""
        """Why it refuses each command; empty: it does not."""
        self.asked = 0
        """How many commands pages have sent."""

    def _carry_out(self, _: object, answer: Answer) -> None:
        self.asked += 1
        answer({"error": self.refused} if self.refused else {"ok": None})

    @staticmethod
    def _stop(answer: Answer) -> None:
        answer({"ok": None})

    def show(self, found: Mapping[str, Any], *, estop: bool = False) -> None:
        """Show a status, and a robot at rest."""
        zeros = [0.0] * len(found["robot"]["joints"])
        state = {"stamp": 1, "estop": estop, "stops": 0, "stale": False, "position": zeros, "command": zeros}
        for channel, message in ((STATUS, found), (STATE, state)):
            self.broadcast.publish(channel, json.dumps(message).encode())

    def publish_picture(self, number: int, picture: NDArray[np.uint8]) -> None:
        """Show a grey picture, shape (H, W)."""
        height, width = picture.shape
        shown = to_picture(Image(Header(1), height, width, "mono8", width, picture.ravel()))
        assert shown is not None
        payload = PICTURE_HEAD.pack(1, 0, 0, JPEG) + shown.content
        self.broadcast.publish(FIRST_PICTURE + number, payload)


async def no_scene() -> bytes:
    return json.dumps({"bodies": [], "meshes": [], "tips": {}, "problem": "this robot has no model"}).encode()


async def until(page: Any, expression: str) -> None:
    async with asyncio.timeout(60):
        while not await page.evaluate(f"Boolean({expression})"):
            await asyncio.sleep(0.02)


async def look() -> None:
    from playwright.async_api import async_playwright

    run = Run()
    app = make_app(run.guard, run.broadcast, run.drive, no_scene)
    async with HttpServer(run.guard, app, close_s=0.1), async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page(device_scale_factor=0.5)
        await page.goto(run.guard.link("drive"))
        for recording in (False, True):
            run.show(status(episode={**EPISODE, "recording": recording}))
            wanted = "Discard" if recording else "Begin"
            await until(
                page, f"window.ibrobot?.operating && document.querySelector('#record').innerText.includes('{wanted}')"
            )
            for (width, height), more in SIZES.items():
                await page.set_viewport_size({"width": width, "height": height})
                assert await page.evaluate(OUT_OF_SIGHT, [*IN_SIGHT, *more]) == [], (width, height, recording)
                assert await page.evaluate("document.documentElement.scrollWidth") <= width
                large = "document.querySelector('.attention').offsetHeight"
                assert await page.evaluate(large) > 0.25 * height, "the picture of attention is large"
        assert await page.locator("#record button", has_text="Again").is_visible()
        await page.evaluate(COUNT_TONES)
        for cues, (cue, words, tones) in enumerate(CUES, 1):
            run.show(status(episode={**EPISODE, "cues": cues, "cue": cue}))
            await until(page, f"document.querySelector('#record').innerText.includes('{words}')")
            await until(page, f"window.tones === {tones}")
        run.show(status(episode={**EPISODE, "waiting": True}))
        await page.get_by_text("Ready: 2 of 10 begins when the robot follows you").wait_for()
        run.show(status(("left_", "right_")))
        await page.set_viewport_size({"width": 1280, "height": 800})
        await until(page, "document.querySelectorAll('.joint').length === 12")
        assert await page.evaluate(OUT_OF_SIGHT, [*IN_SIGHT, "#toggles button"]) == [], (
            "more joints scroll on their own"
        )
        await look_at_one_arm(page, run)
        await look_at_keys(page, run)
        await look_at_keys_pressed_twice(page, run)
        await look_at_messages(page, run)
        await look_at_attention(page, run)
        await page.locator("#mode summary").click()
        assert await page.get_by_role("button", name="drive by keys keyboard needs a terminal").is_disabled()
        await page.get_by_role("button", name="run the policy pick").click()
        assert await page.get_by_text("The robot moves by itself as soon as it is in this mode").is_visible()
        await page.get_by_role("button", name="Cancel").click()
        run.show(status(ended=True))
        await until(page, "document.querySelector('#faults .ended')")
        assert await page.locator("#faults .ended").inner_text() == "The run has ended\n1 of 10 saved"
        assert await page.locator("#drive :enabled, #record button:enabled, #stop:enabled").count() <= 1, (
            "but for the unit"
        )
        await browser.close()


async def look_at_one_arm(page: Any, run: Run) -> None:
    """Of two arms, the page shows the joints of the chosen one, with names that leave out the arm's."""
    two = status(("left_", "right_"))
    joints = [joint["name"] for joint in two["robot"]["joints"]]
    arms = {"page_left": joints[:6], "page_right": joints[6:]}
    two["robot"]["modes"][0]["jogs"] = arms
    two["robot"]["groups"] = {"left": joints[:6], "right": joints[6:]}
    run.show({**two, "jogs": list(arms), "help": "jog from the page\njog from the page"})
    await until(page, "document.querySelectorAll('.joint').length === 6")
    names = page.locator(".joint .name")
    assert await names.all_inner_texts() == [name.removeprefix("left_") for name in joints[:6]]
    await page.get_by_role("button", name="right", exact=True).first.click()
    await until(page, "document.querySelector('.joint .name').title.startsWith('right_')")
    assert await names.all_inner_texts() == [name.removeprefix("right_") for name in joints[6:]]
    await page.keyboard.press("?")
    assert await page.locator("#dialog pre").inner_text() == "jog from the page", "once for both arms"
    await page.get_by_role("button", name="Close").click()
    run.show(status())
    await until(page, "!document.querySelector('.joint .name').title.startsWith('right_')")


async def look_at_messages(page: Any, run: Run) -> None:
    """Errors do not pile up, nor cover what a person presses; no episode begins while the robot is stopped."""
    run.show(status())
    await page.get_by_role("button", name="Begin").wait_for()
    for text in ("one", "two", "three", "four", "five", "five"):
        run.refused = text
        await page.evaluate("void ibrobot.drive.service('/planning/go_to', {goal: 'nowhere'})")
        await page.locator(".toast").get_by_text(text).wait_for()
    shown = page.locator(".toast.error p")
    assert await shown.all_inner_texts() == ["three", "four", "five"], "the last ones, and each once"
    assert await page.evaluate(OUT_OF_SIGHT, ["#stop", "#record button", "#toggles button", ".pad button"]) == []
    run.refused = "six"
    run.show(status(), estop=True)
    await page.get_by_role("button", name="Reset").wait_for()
    await until(page, "document.querySelector('[data-key=b]').disabled")
    await page.keyboard.press("b")
    run.show(status())
    await until(page, "!document.querySelector('[data-key=b]').disabled")
    assert await shown.all_inner_texts() == [], "the stop took the messages away, and the key did nothing"
    run.refused = ""


async def look_at_keys_pressed_twice(page: Any, run: Run) -> None:
    """A key that is pressed twice does once what it does, and the next one does its own at once."""
    run.refused = "counted"
    await page.evaluate("(now => { performance.now = () => now })(performance.now())")  # however slow the machine is
    for recording, keys, sent in ((True, "ssf", 2), (False, "bb", 1), (True, "s", 1)):
        run.show(status(episode={**EPISODE, "recording": recording}))
        await until(page, f"Boolean(document.querySelector('[data-key={keys[0]}]'))")
        before = run.asked
        for key in keys:
            await page.keyboard.press(key)
        await page.evaluate("ibrobot.drive.service('/planning/go_to', {goal: 'nowhere'})")  # answered after the others
        assert run.asked - before == sent + 1
    await page.evaluate("delete performance.now")
    run.refused = ""
    await page.evaluate("import('/static/dom.js').then(({ clearToasts }) => clearToasts())")


async def look_at_keys(page: Any, run: Run) -> None:
    """`?` lists the keys that do something now."""
    for recording, keys in ((False, ["B", "R"]), (True, ["S", "F", "D", "R"])):
        run.show(status(episode={**EPISODE, "recording": recording}))
        await until(page, f"Boolean(document.querySelector('[data-key={keys[0].lower()}]'))")
        await page.keyboard.press("?")
        shown = await page.locator("#dialog kbd").all_inner_texts()
        assert shown == ["Esc", *keys, "1", "2", "3", "?"]
        await page.get_by_role("button", name="Close").click()


async def look_at_attention(page: Any, run: Run) -> None:
    """What a policy attends to lies over the camera's picture in red, when asked for; another camera's is a picture."""
    topics = ("/camera/top/image", "/attention/top", "/attention/side")
    cameras = [{"channel": FIRST_PICTURE + i, "topic": topic} for i, topic in enumerate(topics)]
    run.show(status(cameras=cameras))
    await until(page, "document.querySelectorAll('figure.picture').length === 2")
    names = await page.locator("figure.picture").evaluate_all("(every) => every.map((each) => each.dataset.name)")
    assert names == ["top", "side"]
    await page.keyboard.press("2")
    box = page.get_by_label("attention")
    assert not await box.is_checked()
    looks = np.zeros((16, 16), np.uint8)
    looks[:8, :8] = 255
    await box.check()
    corners = """[1, 38].map((at) =>
        [...document.querySelector('canvas.looks').getContext('2d').getImageData(at, at, 1, 1).data])"""
    while (await page.evaluate(corners))[0][3] < 100:
        run.publish_picture(0, np.zeros((40, 40), np.uint8))
        run.publish_picture(1, looks)  # until the page's wish to see it has arrived
        await asyncio.sleep(0.02)
    shown, bare = await page.evaluate(corners)
    assert shown[0] > 250, "red"
    assert shown[1] < 5
    assert bare[3] < 20
    await box.uncheck()
    assert await page.locator("canvas.looks").is_hidden()


def test_pictures_and_controls_are_visible_without_scrolling() -> None:
    pytest.importorskip("playwright.async_api", reason="needs playwright: pip install playwright")
    asyncio.run(asyncio.wait_for(look(), 120))
