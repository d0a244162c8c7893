"""Texts of the pages in headless Chromium: what stands between backticks is code, and nothing in a text is markup."""

from __future__ import annotations

import asyncio
import json
import random
import re
import shutil
from typing import Any

import pytest
from ibrobot_http.server import HttpServer
from ibrobot_web.options import WebOptions
from ibrobot_web.server.app import make_app
from ibrobot_web.server.broadcast import Broadcast
from ibrobot_web.server.drive import Drive
from ibrobot_web.server.page_guard import page_guard

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
CODE = re.compile("`([^`\n]+)`")
PIECES = (
    "`",
    "``",
    "<b>",
    "</b>",
    "&amp;",
    "<script>",
    "\n",
    " ",
    "ibrobot config check",
    "`a`",
    "名",
    "'",
    '"',
    "${x}",
)
SHOWN = """async (texts) => {
    const { h, refresh, say } = await import("/static/dom.js");
    return texts.map((text) => {
        const made = h("p", {}, text), said = h("p"), replaced = h("div");
        say(said, "`before`");
        say(said, text);
        refresh(replaced, text, () => [text]);
        return [made, said, replaced].map((each) => (
            [each.textContent, [...each.children].map(({ localName, textContent }) => [localName, textContent])]));
    });
}"""
"""What elements with the texts show: their text, and name and text of each element within."""
VERBATIM = """async (text) => {
    const { h } = await import("/static/dom.js");
    return ["code", "option", "pre", "textarea"].map((tag) => h(tag, {}, text).textContent);
}"""
RESTS = """async () => {
    const { h, say } = await import("/static/dom.js");
    const element = h("p", {}, "run `ibrobot ui`"), first = element.firstChild;
    say(element, "run `ibrobot ui`");
    return element.firstChild === first;
}"""


def texts(count: int) -> list[str]:
    """Texts of pieces that could be taken for code or for markup."""
    chance = random.Random(45)
    return ["".join(chance.choices(PIECES, k=chance.randint(1, 9))) for _ in range(count)]


async def look() -> None:
    from playwright.async_api import async_playwright

    async def no_scene() -> bytes:
        return json.dumps({"bodies": [], "meshes": [], "tips": {}, "problem": ""}).encode()

    guard = page_guard(WebOptions(port=0), any_port="0")
    drive = Drive(lambda _, answer: answer({"ok": None}), lambda answer: answer({"ok": None}), lambda: None)
    app = make_app(guard, Broadcast(lambda: None, frozenset()), drive, no_scene)
    async with HttpServer(guard, app, close_s=0.1), async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = await browser.new_page()
        await page.goto(guard.link("watch"))
        made = texts(2000)
        for text, shown in zip(made, await page.evaluate(SHOWN, made), strict=True):
            expected: list[Any] = [CODE.sub(r"\1", text), [["code", code] for code in CODE.findall(text)]]
            assert shown == [expected] * 3, repr(text)
        assert await page.evaluate(VERBATIM, "`a` <b>") == ["`a` <b>"] * 4
        assert await page.evaluate(RESTS), "a text that did not change rests"
        await browser.close()


def test_code_is_shown_as_code_and_no_text_is_markup() -> None:
    pytest.importorskip("playwright.async_api", reason="needs playwright: pip install playwright")
    asyncio.run(asyncio.wait_for(look(), 120))
