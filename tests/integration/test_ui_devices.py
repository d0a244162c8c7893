"""The guides of plugins on the page of `ibrobot ui`: an emulated arm is calibrated by answers of a browser."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ibrobot_calibration import load_calibration
from ui_server import UiServer, run_ui

pytestmark = pytest.mark.integration
MIDDLES = {1: 2500, 2: 300, 3: 2048, 4: 3900, 5: 1000, 6: 100}
"""Servo -> where its encoder is in the middle pose."""
ENDS = {1: (797, 3297), 2: (900, 3190), 3: (950, 3150), 4: (970, 3120), 6: (1400, 2700)}
"""Servo -> what it reports at its joint's ends, once the middle is at 2048."""


class Hand:
    """Moves the joints to both ends and back, a step whenever the servos are asked something."""

    def __init__(self, emulator: Any) -> None:
        self._emulator = emulator
        self._path: Iterator[float] = iter(())
        self.moves = False
        for servo, middle in MIDDLES.items():
            emulator.servos[servo].turn(middle)
        emulator.on_request = self._move

    def _move(self) -> None:
        if not self.moves:
            return
        step = next(self._path, None)
        if step is None:
            self._path = iter([i / 4 for i in (*range(-4, 5), *range(4, -5, -1))])
            return
        for servo, (low, high) in ENDS.items():
            reported = 2048 + step * (high - 2048 if step > 0 else 2048 - low)
            self._emulator.servos[servo].turn(round(reported + MIDDLES[servo] - 2048) % 4096)


async def until(server: UiServer, what: str) -> dict[str, Any]:
    """The state of the guide once it asks for something, or has ended as `what` says."""
    async with asyncio.timeout(30):
        while True:
            found: dict[str, Any] = await server.get("devices/state")
            if what in (found["ask"] or {}).get("text", "") + found["error"] + found["state"]:
                return found
            assert found["state"] == "running", found
            await asyncio.sleep(0.02)


def test_an_arm_is_calibrated_on_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ibrobot_feetech.emulator import Emulator

    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    async def test(server: UiServer) -> None:
        guides = {each["name"]: each for each in (await server.get("devices/list"))["guides"]}
        order = ["ports", "port", "motors", "calibration", "servos", "cameras", "lens", "mount"]
        assert [name for name in guides if name in order] == order  # as a person sets up an arm
        questions = [each["name"] for each in guides["calibration"]["questions"]]
        assert questions == ["port", "leader", "name", "zero_at", "auto"]
        for wrong, why in (({"zero_at": "noon"}, "is not one of"), ({"leader": "yes"}, "must be a bool")):
            with pytest.raises(RuntimeError, match=why):
                await server.post("devices/start", name="calibration", answers={"port": emulator.port, **wrong})

        answers = {"port": emulator.port, "name": "left"}
        number = (await server.post("devices/start", name="calibration", answers=answers))["number"]
        ask = (await until(server, "middle of its range"))["ask"]
        with pytest.raises(RuntimeError, match="Calibrate an arm is running"):
            await server.post("devices/start", name="ports")
        await server.post("devices/answer", number=number, ask=ask["ask"])
        await until(server, "to both ends")
        hand.moves = True
        async with asyncio.timeout(30):
            while True:
                ask = (await until(server, "to both ends"))["ask"]
                spans = {int(row[0]): int(row[5]) for row in ask.get("rows", ())}
                if spans == {servo: high - low for servo, (low, high) in ENDS.items()}:
                    break
                await asyncio.sleep(0.02)
        await server.post("devices/answer", number=number, ask=ask["ask"])
        shown = await until(server, "done")
        assert "written to servos 1, 2, 3, 4, 5, 6" in shown["items"][-1]["text"]
        for joint in load_calibration("left").joints.values():
            assert (joint.range_min, joint.range_max) == ENDS.get(joint.id, (0, 4095))
            assert emulator.servos[joint.id].get("homing_offset") == joint.homing_offset == MIDDLES[joint.id] - 2048

        number = (await server.post("devices/start", name="calibration", answers=answers))["number"]
        ask = (await until(server, "Calibrate again?"))["ask"]
        await server.post("devices/answer", number=number, ask=ask["ask"], ok=False)
        assert (await until(server, "failed"))["error"]
        number = (await server.post("devices/start", name="servos", answers={**answers, "name": "../x"}))["number"]
        assert "give a name, not a path" in (await until(server, "failed"))["error"]
        number = (await server.post("devices/start", name="motors", answers={**answers, "joint": "gripper"}))["number"]
        await until(server, "Connect only the servo of gripper")
        await server.post("devices/cancel", number=number)
        assert "cancelled" in (await until(server, "failed"))["error"]

    with Emulator(6) as emulator:
        hand = Hand(emulator)
        run_ui([tmp_path], test)
