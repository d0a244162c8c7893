"""An agent at a run with a page: a person sees what it asks for, lets it move, and takes that back."""

from __future__ import annotations

import asyncio
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from ibrobot_mcp.tokens import add_token
from ibrobot_testing.ports import free_port
from mcp import Client
from mcp.client.streamable_http import streamable_http_client
from page_run import page_run

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"]
WAIT_MS = 120_000
WORDS = {
    "en-US": (
        "1:claude asks for /planning/go_to", "Show the path", "The path takes", "Let the agent move", "Take it back",
        "may look, plan and stop",
    ),
    "zh-CN": ("1:claude 请求 /planning/go_to", "显示路径", "秒", "允许智能体移动", "收回", "可以查看、规划和停止"),
}  # fmt: skip


BEFORE_A_CLICK = """async () => {
  const { Agents } = await import(new URL("agents.js", document.querySelector('script[src$="app.js"]').src));
  const section = document.createElement("section");
  const made = new Agents(section, { operating: true }, null);
  const sees = (asked) => {
    const agents = { connected: ["1:a"], armed: "", left_s: 0, speed: null, ended: "", asked };
    made.update({ agents, services: ["/agent/arm"], faults: [] });
    return section.querySelector("form button").disabled;
  };
  const first = sees(null);
  made.readable = 0;
  return [first, sees(null), sees({ agent: "1:a", service: "/x", request: "", refused: true, goal: "" })];
}"""
"""Whether the button that lets an agent move waits: at first, after a moment, and for a new request."""


class AgentOverHttp:
    """An agent that calls from a thread of its own."""

    def __init__(self, url: str, token: str) -> None:
        self._started = threading.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(url, token)))
        self._thread.start()
        assert self._started.wait(WAIT_MS / 1000)

    async def _serve(self, url: str, token: str) -> None:
        self._loop, self._end = asyncio.get_running_loop(), asyncio.Event()
        async with (
            httpx2.AsyncClient(headers={"Authorization": f"Bearer {token}"}, timeout=60) as http,
            Client(streamable_http_client(url, http_client=http), mode="legacy") as self._client,
        ):
            await self._client.list_tools()
            self._started.set()
            await self._end.wait()

    def call(self, tool: str, **arguments: Any) -> Any:
        calling = self._client.call_tool(tool, arguments)
        return asyncio.run_coroutine_threadsafe(calling, self._loop).result(WAIT_MS / 1000)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()


@pytest.fixture
def agent_and_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[AgentOverHttp, str]]:
    for name in ("XDG_RUNTIME_DIR", "XDG_STATE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    port = free_port()
    robot = ("so101_blind", "--sim", "--mode", "moveit_planning", "--set", "control.peer_timeout=5")
    with page_run(*robot, "--set", f"mcp.port={port}") as address:
        agent = AgentOverHttp(f"http://127.0.0.1:{port}/mcp", add_token("claude"))
        yield agent, address
        agent.close()


def until(page: Any, expression: str) -> None:
    """Wait until a JavaScript expression is true; the page's rules forbid Playwright's own way."""
    waited = 0
    while not page.evaluate(expression):
        page.wait_for_timeout(50)
        waited += 50
        assert waited < WAIT_MS, f"still not: {expression}"


def pan(page: Any) -> float:
    position: float = page.evaluate("ibrobot.state.command[0]")
    return position


@pytest.mark.parametrize("language", ["en-US", "zh-CN"])
def test_person_sees_what_an_agent_asks_for_lets_it_move_and_takes_that_back(
    agent_and_address: tuple[AgentOverHttp, str], language: str
) -> None:
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright: pip install playwright")
    agent, address = agent_and_address
    asks, show, takes, arm, back, idle = WORDS[language]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(locale=language)
        page.set_default_timeout(WAIT_MS)
        page.goto(address)
        until(page, "Boolean(window.ibrobot?.operating && ibrobot.state)")
        agents = page.locator("#agents")
        agents.get_by_text(idle).wait_for()
        refused = agent.call("go_to", goal="shoulder_pan=1.5")
        assert "may not move the robot" in refused.content[0].text
        agents.get_by_text(asks).wait_for()
        assert page.evaluate(BEFORE_A_CLICK) == [True, False, True]
        agents.get_by_role("button", name=show).click()
        page.locator(".toasts").get_by_text(takes).wait_for()
        assert abs(pan(page)) < 0.02, "nothing has moved"

        agents.get_by_role("spinbutton").last.fill("5")
        agents.get_by_role("button", name=arm).click()
        agents.get_by_role("button", name=back).wait_for()
        assert not agent.call("go_to", goal="shoulder_pan=1.5").is_error
        until(page, "ibrobot.state.command[0] > 0.1")
        agents.get_by_role("button", name=back).click()
        agents.get_by_role("button", name=arm).wait_for()
        assert agent.call("state").structured_content["authority"]["ended"] == "disarmed"
        still = "(before => (ibrobot.before = ibrobot.state.command[0]) === before)(ibrobot.before)"
        until(page, still)
        assert pan(page) < 1.4
        browser.close()
