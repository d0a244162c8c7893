"""The page's server through its port: who may connect, who has control, and what happens to wrong messages."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import override
from unittest.mock import patch

import attrs
import numpy as np
import pytest
from ibrobot_http.certificates import own_certificate
from ibrobot_testing import host_context, stand_in
from ibrobot_testing.http import HttpSuite, Served
from ibrobot_webxr.certificate import own_folder
from ibrobot_webxr.options import WebxrOptions
from ibrobot_webxr.server import PageServer
from ibrobot_webxr.teleop import WebxrTeleop

from ibrobot_core.api import (
    Bool,
    Context,
    Header,
    Image,
    JointReading,
    RealClock,
    RobotStatus,
    SteppedClock,
    TeleopError,
    ns,
)
from ibrobot_core.app import Bus

from .browser import Browser, hand, hands
from .rig import ANY_PORT, BENT, page_of, robot_of


@pytest.fixture
def ctx(mjcf: Path) -> Context:
    return host_context("phone", robot=robot_of(mjcf), clock=SteppedClock(ns(1000.0)))


@pytest.fixture
def teleop(ctx: Context) -> Iterator[WebxrTeleop]:
    teleop = WebxrTeleop(ANY_PORT, ctx)
    teleop.connect()
    teleop.activate(measured(ctx))
    yield teleop
    teleop.disconnect()


@pytest.fixture
def page(ctx: Context, teleop: WebxrTeleop) -> Iterator[PageServer]:
    with page_of(ANY_PORT, ctx) as page:
        yield page


@pytest.fixture
def browser(page: PageServer) -> Iterator[Browser]:
    with Browser(page.address) as browser:
        yield browser


def measured(ctx: Context) -> JointReading:
    return JointReading(ctx.clock.now_ns(), BENT.copy(), np.zeros(6), np.zeros(6))


def later(ctx: Context) -> JointReading:
    """A reading after some time, in which a device that is silent must have stopped the robot."""
    assert isinstance(ctx.clock, SteppedClock)
    ctx.clock.advance(ns(0.5))
    return measured(ctx)


class TestAttacks(HttpSuite):
    """What every server here withstands, on the routes of the page."""

    @override
    @contextlib.contextmanager
    def serve(self, request_s: float) -> Iterator[Served]:
        with patch("ibrobot_http.guard.REQUEST_S", request_s):
            page = PageServer(ANY_PORT, RealClock(), Bus(RealClock()), logging.getLogger("ibrobot.test"))
            with contextlib.closing(page):
                url, _, token = page.address.partition("/?")
                yield Served(
                    url,
                    ("/", "/certificate.pem", "/static/main.js"),
                    sockets=("/socket",),
                    links=(f"/?{token}",),
                    other_sites_link=True,
                )


@pytest.mark.parametrize(
    "name", ["main.js", "connection.js", "controls.js", "headset.js", "phone.js", "pose.js", "screens.js", "index.html"]
)
def test_files_of_the_page_name_no_other_host(page: PageServer, browser: Browser, name: str):
    assert browser.get(f"/static/{name}")[0] == 401
    status, text, _ = browser.log_in().get(f"/static/{name}")
    assert status == 200
    assert "http://" not in text
    assert "https://" not in text


def test_the_page_offers_its_own_certificate_for_phones_to_install(
    ctx: Context, page: PageServer, browser: Browser, tmp_path: Path
):
    assert browser.get("/certificate.pem")[0] == 401
    status, text, headers = browser.log_in().get("/certificate.pem")
    assert (status, headers["Content-Type"]) == (200, "application/x-x509-ca-cert")
    assert text == (own_folder() / "certificate.pem").read_text()
    certificate, key = own_certificate(tmp_path, ["localhost", "127.0.0.1"])
    given = attrs.evolve(ANY_PORT, certificate=certificate, key=key)
    other = PageServer(given, ctx.clock, Bus(ctx.clock), logging.getLogger("ibrobot.test"))
    with contextlib.closing(other), Browser(other.address) as second:
        assert "ca.pem" in second.log_in().get("/certificate.pem")[1]


def test_each_launch_has_another_token(page: PageServer, browser: Browser):
    other = PageServer(ANY_PORT, RealClock(), Bus(RealClock()), logging.getLogger("ibrobot.test"))
    other.close()
    assert other.address.partition("token=")[2] != page.address.partition("token=")[2]


def engage(browser: Browser, teleop: WebxrTeleop, ctx: Context, n: int = 1) -> None:
    browser.send_hands(n, right=hand())
    teleop.read(measured(ctx))
    browser.send_hands(n + 1, right=hand(clutch=True))


def test_a_hand_moves_the_robot_through_the_page(ctx: Context, teleop: WebxrTeleop, browser: Browser):
    browser.log_in().connect()
    assert browser.state()["control"] == "you"
    engage(browser, teleop, ctx)
    first = teleop.read(measured(ctx)).positions
    assert first is not None
    assert first == dict(zip(ctx.robot.joint_names, BENT, strict=True))
    for i in range(8):
        browser.send_hands(3 + i, right=hand(clutch=True, position=[0, 1, -0.01 * i]))
        ctx.clock.sleep_until(ctx.clock.now_ns() + ns(0.01))
        last = teleop.read(measured(ctx)).positions
    assert last is not None
    assert abs(last["shoulder_lift"] - first["shoulder_lift"]) > 1e-3
    state = browser.state()["hands"]["right"]
    assert (state["device"], state["engaged"]) == ("phone", True)


def test_a_page_that_disappears_holds_the_robot(ctx: Context, teleop: WebxrTeleop, browser: Browser):
    browser.log_in().connect()
    engage(browser, teleop, ctx)
    assert teleop.read(measured(ctx)).positions is not None
    gone_s = time.monotonic()
    browser.disconnect()
    while teleop.operate(later(ctx)).positions is not None:
        assert time.monotonic() - gone_s < 5
        time.sleep(0.002)


def test_a_second_page_only_watches(ctx: Context, teleop: WebxrTeleop, page: PageServer, browser: Browser):
    browser.log_in().connect()
    browser.send_hands(1, right=hand())
    with Browser(page.address) as second:
        second.log_in().connect()
        assert second.state()["control"] == "other"
        second.send_hands(1, right=hand())  # answered, so that the page does not take the network for gone
        second.send_hands(2, right=hand(clutch=True))
        second.send({"type": "press", "event": "start"})
        second.send({"type": "claim"})
        assert second.state()["control"] == "other"
        command = teleop.read(measured(ctx))
        assert command.positions is None
        assert command.events == ()
        engage(browser, teleop, ctx, 2)
        assert teleop.read(measured(ctx)).positions is not None
        second.send({"type": "stop"})  # anybody may stop a robot
        assert second.state()
        assert teleop.read(measured(ctx)).estop
        browser.disconnect()
        second.state(control="free")
        second.send({"type": "claim"})
        second.state(control="you")
        engage(second, teleop, ctx)
        assert teleop.read(measured(ctx)).positions is not None


def test_a_silent_page_loses_control(
    ctx: Context, teleop: WebxrTeleop, browser: Browser, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("ibrobot_webxr.server._SILENT_S", 0.3)
    browser.log_in().connect()
    engage(browser, teleop, ctx)
    assert browser.state(control="free")
    teleop.operate(later(ctx))
    assert teleop.operate(later(ctx)).positions is None
    browser.send({"type": "claim"})
    assert browser.state(control="you")


def test_a_page_that_opens_while_the_host_pauses_keeps_control(
    page: PageServer, browser: Browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ibrobot_webxr.server._SILENT_S", 0.5)
    browser.log_in().connect()
    assert page._server is not None
    page._server.loop.call_soon_threadsafe(time.sleep, 0.8)
    assert browser.state()["control"] == "you"


def test_the_stop_reaches_the_run_in_any_mode(ctx: Context, page: PageServer, browser: Browser):
    assert ctx.bus is not None
    stopped: list[object] = []
    ctx.bus.serve(stand_in("/estop"), stopped.append)
    browser.log_in().connect()
    browser.send({"type": "stop"})
    browser.state()
    assert stopped == [None]


def test_buttons_reach_the_run(ctx: Context, teleop: WebxrTeleop, browser: Browser):
    browser.log_in().connect()
    for event in ("start", "success", "intervention"):
        browser.send({"type": "press", "event": event})
    browser.send_hands(1)
    assert teleop.read(measured(ctx)).events == ("start", "success", "intervention")


GARBAGE = {
    "": "not JSON",
    "{": "not JSON",
    "[" * 3000: "not JSON",
    "7": "not a JSON object",
    '["hands"]': "not a JSON object",
    "{}": "type: must be hands, press, stop, claim or shown",
    '{"type": "go"}': "type: must be hands, press, stop, claim or shown",
    '{"type": {"a": 1}}': "type: must be hands, press, stop, claim or shown",
    '{"type": "press", "event": "reboot"}': "event: must be one of start, success, failure, discard, intervention",
    '{"type": "press"}': "event is missing",
    '{"type": "stop", "now": true}': "unknown keys; must have none",
    '{"type": "shown", "camera": 9}': "camera: must be below 0",
    '{"type": "shown", "camera": -1}': "camera: must be a whole number, at least 0",
    '{"type": "hands"}': "hands is missing",
    json.dumps({**hands(), "n": 1.5}): "n: must be a whole number, at least 0",
    json.dumps({**hands(), "t": "now"}): "t: must be a number from 0 to 1e+12",
    json.dumps({**hands(), "t": float("nan")}): "not JSON",
    json.dumps({**hands(), "heading": float("inf")}): "not JSON",
    json.dumps({**hands(), "heading": 99}): "heading: must be a number from -7 to 7",
    json.dumps({**hands(), "hands": []}): "hands: must be an object with the keys left and right, or fewer",
    json.dumps(hands(third=hand())): "hands: must be an object with the keys left and right, or fewer",
    json.dumps(hands(right=7)): "hands.right: must be an object",
    json.dumps(hands(right={})): "hands.right: clutch is missing",
    json.dumps(hands(right=hand(clutch=1))): "hands.right.clutch: must be true or false",
    json.dumps(hands(right=hand(clutch=True, position=[0, 1]))): "hands.right.position: must be a list of 3 numbers",
    json.dumps(hands(right=hand(position=[0, 1e9, 0]))): "hands.right.position: must be a number from -100 to 100",
    json.dumps(hands(right=hand(orientation=[0, 0, 0, 0]))): "hands.right.orientation: must be a unit quaternion",
    json.dumps(
        hands(right=hand(orientation=[0, 0, 0, 3]))
    ): "hands.right.orientation: must be a number from -1.01 to 1.01",
    json.dumps(hands(right=hand(gripper=2))): "hands.right.gripper: must be a number from 0 to 1",
    json.dumps(hands(right=hand(open="yes"))): "hands.right.open: must be a number from -1 to 1",
    json.dumps(hands(right=hand(move=[0, 0, True]))): "hands.right.move: must be a number from -1 to 1",
    json.dumps(
        hands(right=hand(jump=1))
    ): "hands.right: unknown keys; must have clutch, gripper, move, open, orientation, position",
}


def test_garbage_is_refused_by_a_message_each_and_moves_nothing(
    ctx: Context, teleop: WebxrTeleop, browser: Browser, caplog: pytest.LogCaptureFixture
):
    browser.log_in().connect()
    engage(browser, teleop, ctx)
    assert teleop.read(measured(ctx)).positions is not None
    for i, (text, message) in enumerate(GARBAGE.items()):
        browser.send(text)
        browser.send_hands(3 + i, right=hand(clutch=True))
        positions = teleop.read(measured(ctx)).positions
        assert positions is not None
        np.testing.assert_array_equal(list(positions.values()), BENT)
        assert f"webxr: refused a message of the page: {message}" in caplog.messages
    assert browser.state()["error"] == list(GARBAGE.values())[-1]
    browser.send(b"\x00\x01")
    browser.send_hands(100, right=hand(clutch=True))
    assert "webxr: refused a message of the page: not text" in caplog.messages
    assert len(caplog.messages) == len(set(GARBAGE.values())) + 1, "each reason is logged once"


@pytest.mark.parametrize("size", [4097, 100_000])
def test_a_message_that_is_too_long_ends_the_connection(ctx: Context, teleop: WebxrTeleop, browser: Browser, size: int):
    browser.log_in().connect()
    engage(browser, teleop, ctx)
    browser.send("x" * size)
    deadline = time.monotonic() + 5
    while browser.is_connected:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_page_that_sends_only_garbage_is_disconnected(browser: Browser):
    browser.log_in().connect()
    for _ in range(100):
        browser.send("?")
    deadline = time.monotonic() + 5
    while browser.is_connected:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_images_come_newest_first_as_the_page_shows_them(ctx: Context, browser: Browser):
    assert ctx.bus is not None
    pixels = np.zeros((8, 8, 3), np.uint8)
    raw = Image(Header(0), 8, 8, "rgb8", 24, pixels.reshape(-1))
    ctx.bus.publish("/camera/top/image_raw", raw)
    depth = Image(Header(0), 8, 8, "16UC1", 16, np.zeros(128, np.uint8))
    ctx.bus.publish("/camera/depth/image_raw", depth)
    ctx.bus.publish("/camera/top/ready", Bool(True))
    ctx.bus.publish("/camera/torn/image_raw", attrs.evolve(raw, data=raw.data[:9]))
    browser.log_in().connect()
    state = browser.wait_for(lambda message: message.get("cameras"))
    top = state["cameras"].index("top")
    for name, image in (("torn", attrs.evolve(raw, data=raw.data[:9])), ("top", raw)):
        ctx.bus.publish(f"/camera/{name}/image_raw", image)
    deadline = time.monotonic() + 5
    while not browser.images:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    assert browser.images[0][0] == top
    jpeg = browser.images[0][1:]
    assert jpeg.startswith(b"\xff\xd8")
    for _ in range(3):  # not shown yet: no further image comes
        ctx.bus.publish("/camera/top/image_raw", raw)
        browser.state()
    assert len(browser.images) == 1
    browser.send({"type": "shown", "camera": top})
    while len(browser.images) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_the_page_shows_the_robots_mode_and_faults(ctx: Context, browser: Browser):
    assert ctx.bus is not None
    browser.log_in().connect()
    ctx.bus.publish("/robot_status", RobotStatus(Header(0), "so101", "phone", estop=True, faults=("emergency stop",)))
    state = browser.wait_for(lambda message: message.get("robot"))
    assert state["robot"] == {"name": "so101", "mode": "phone", "estop": True, "faults": ["emergency stop"]}


def test_a_port_in_use_is_an_error(ctx: Context, page: PageServer):
    assert ctx.bus is not None
    taken = attrs.evolve(ANY_PORT, port=page.port)
    with pytest.raises(TeleopError, match=rf"port {page.port} of 127\.0\.0\.1 is not available: .*; choose another"):
        PageServer(taken, ctx.clock, ctx.bus, ctx.log)


def test_a_certificate_that_does_not_fit_is_an_error(tmp_path: Path, ctx: Context):
    assert ctx.bus is not None
    (tmp_path / "a.pem").write_text("no certificate")
    options = WebxrOptions(port=0, certificate=tmp_path / "a.pem", key=tmp_path / "a.pem")
    with pytest.raises(TeleopError, match=r"certificate .*a\.pem and key .*a\.pem cannot be used"):
        PageServer(options, ctx.clock, ctx.bus, ctx.log)


def test_a_stop_needs_no_thread_that_is_not_there_yet(ctx: Context, monkeypatch: pytest.MonkeyPatch):
    assert ctx.bus is not None
    called = threading.Event()
    ctx.bus.serve(stand_in("/estop"), lambda request: called.set())
    server = PageServer(ANY_PORT, ctx.clock, ctx.bus, ctx.log)
    try:
        with monkeypatch.context() as patch:
            patch.setattr(threading.Thread, "start", _refuse)
            assert server._server is not None
            asyncio.run_coroutine_threadsafe(server._stop(), server._server.loop).result(30.0)
        assert called.is_set()
    finally:
        server.close()


def _refuse(thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_a_stop_that_would_fail_is_an_error_at_the_start(ctx: Context):
    assert ctx.bus is not None

    def check(request: None) -> None:
        raise TeleopError("control does not answer")

    ctx.bus.serve(stand_in("/estop/check"), check)
    with pytest.raises(TeleopError, match="control does not answer"):
        PageServer(ANY_PORT, ctx.clock, ctx.bus, ctx.log)
