"""A run of a robot that nothing here knows: seven joints, one of which slides, three cameras, and an object."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from page_run import client, page_run
from seven_joints import CAMERAS, JOINTS, write_seven_joints

from ibrobot_core.app import installed_plugins

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(("hardware", "mujoco") not in installed_plugins().entries, reason="needs ibrobot-plugin-mujoco"),
]


def test_the_page_shows_and_drives_it(tmp_path: Path) -> None:
    yaml = write_seven_joints(tmp_path)

    async def test(address: str) -> None:
        async with client(address) as page:
            await page.call("operate", take_over=True)
            await page.until(lambda: page.states and page.status.get("jogs"))
            robot = page.status["robot"]
            assert [joint["name"] for joint in robot["joints"]] == list(JOINTS)
            assert set(robot["poses"]) == {"home", "bent"}
            if page.status["absent"]:
                pytest.skip("no OpenGL here")
            await page.until(lambda: len({channel for channel, *_ in page.pictures}) == len(CAMERAS))
            assert {camera["topic"].split("/")[2] for camera in page.status["cameras"]} == set(CAMERAS)
            (crate,) = page.status["objects"]
            assert (crate["name"], crate["size"], crate["pos"]) == ("crate", [0.05] * 3, [0.4, 0.2, 0.05])
            before = page.states[-1]["position"]
            await page.jog(1.0, joints={"turn": 0.5, "finger": 1.0})
            after = page.states[-1]["position"]
            assert after[0] > before[0] + 0.1
            assert after[-1] > before[-1] + 0.01, "the joint that slides"
            async with page.get("/api/scene") as answer:
                scene = await answer.json()
            assert [joint["type"] for body in scene["bodies"] for joint in body["joints"]] == ["hinge"] * 6 + ["slide"]
            assert len(scene["cameras"]) == len(CAMERAS)

    with page_run(str(yaml), "--sim") as address:
        asyncio.run(asyncio.wait_for(test(address), 60))
