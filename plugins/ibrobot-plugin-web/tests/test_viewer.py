"""The viewer: conformance with the server's process behind it, and its errors."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path
from typing import Any, override

import attrs
import numpy as np
import pytest
from ibrobot_testing import ViewerSuite, check_descriptor, host_context, make_session
from ibrobot_web import ibrobot_viewers
from ibrobot_web.options import WebOptions
from ibrobot_web.viewer import WebViewer

from ibrobot_core.api import Context, Header, IbrobotError, JointState, Message, Viewer
from ibrobot_core.app import ComponentFailed, ControlState, Session

OPTIONS = WebOptions(port=0, browser=False, rate_hz=60)


def state(i: int, stamp_ns: int) -> ControlState:
    zeros = np.zeros(6)
    position = np.full(6, 0.01 * i)
    return ControlState(i, stamp_ns, 0, 0, False, False, None, position, zeros, zeros, position, np.empty(0))


def make_context() -> Context:
    session = make_session()
    return attrs.evolve(host_context("viewer", bus=session.bus, clock=session.clock), session=session)


class TestConformance(ViewerSuite):
    @override
    def context(self) -> Context:
        return make_context()

    @override
    def make(self, ctx: Context) -> WebViewer:
        return WebViewer(OPTIONS, ctx)

    @override
    def message(self, ctx: Context, i: int) -> Message:
        session = ctx.session
        assert isinstance(session, Session)
        now = state(i, ctx.clock.now_ns())
        session.take_state(now)
        return JointState(Header(now.stamp_ns), ctx.robot.joint_names, now.position)

    @override
    def shut(self, viewer: Viewer) -> None:
        assert isinstance(viewer, WebViewer)
        viewer.finish()

    @override
    def shown(self, viewer: Viewer) -> Message:
        assert isinstance(viewer, WebViewer)
        assert viewer.newest is not None
        newest: Mapping[str, Any] = viewer.newest
        names = make_session().config.robot.joint_names
        return JointState(Header(newest["stamp"]), names, np.array(newest["position"]))


def test_descriptor() -> None:
    (descriptor,) = ibrobot_viewers()
    check_descriptor(descriptor, OPTIONS)
    assert descriptor.flag == "--web"


def test_the_address_has_a_token_and_the_page_is_gone_after_close() -> None:
    viewer = WebViewer(OPTIONS, make_context())
    viewer.open()
    try:
        found = re.fullmatch(r"(http://127\.0\.0\.1:\d+/)\?token=\S+  \(to watch only: http://\S+\)", viewer.where())
        assert found is not None
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(found[1])
    finally:
        viewer.close()
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(found[1])


def test_the_last_status_says_that_the_run_has_ended() -> None:
    from page_run import client

    async def test(viewer: WebViewer) -> None:
        async with client(viewer.url) as page:
            while not page.status:
                viewer.update()
                await asyncio.sleep(0.01)
            assert page.status["ended"] is False
            await asyncio.to_thread(viewer.close)
            await page.until(lambda: page.status["ended"])

    viewer = WebViewer(OPTIONS, make_context())
    viewer.open()
    try:
        asyncio.run(asyncio.wait_for(test(viewer), 60))
    finally:
        viewer.close()


def test_a_port_in_use_is_an_error_with_a_remedy() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        viewer = WebViewer(attrs.evolve(OPTIONS, port=port), make_context())
        with pytest.raises(IbrobotError, match=f"port {port} of 127.0.0.1 is not available: .*viewer.port=0"):
            viewer.open()
        viewer.close()


def test_a_certificate_that_cannot_be_used_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.pem").write_text("no certificate")
    viewer = WebViewer(attrs.evolve(OPTIONS, certificate=tmp_path / "a.pem", key=tmp_path / "a.pem"), make_context())
    with pytest.raises(IbrobotError, match=r"a\.pem cannot be used"):
        viewer.open()
    viewer.close()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"host": "0.0.0.0"}, "needs TLS: give certificate and key"),
        ({"host": "192.168.1.5", "key": Path("key.pem")}, "certificate and key belong together"),
        ({"password": "short"}, "password must have at least 12 characters"),
    ],
)
def test_options_that_would_open_the_robot_to_the_network_are_refused(options: dict[str, Any], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        WebOptions(**options)


def test_the_page_needs_a_run() -> None:
    with pytest.raises(IbrobotError, match="viewer type web shows a run"):
        WebViewer(OPTIONS, host_context("viewer")).open()


def updated_until_it_fails(viewer: WebViewer) -> str:
    """Update a viewer until it ends the run; return why."""
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s:
        try:
            viewer.update()
        except ComponentFailed as failed:
            return str(failed)
        time.sleep(0.01)
    raise AssertionError("the run goes on")


def test_a_server_that_is_stopped_ends_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = WebViewer(OPTIONS, make_context())
    viewer.open()
    assert viewer._child is not None
    pid = viewer._child.pid
    try:
        monkeypatch.setattr("ibrobot_web.viewer._SILENT_S", 0.7)
        os.kill(pid, signal.SIGSTOP)
        assert "silent for 0.7 s: its STOP would not be heard" in updated_until_it_fails(viewer)
    finally:
        os.kill(pid, signal.SIGCONT)
        viewer.close()


def test_a_server_that_dies_ends_the_run() -> None:
    viewer = WebViewer(OPTIONS, make_context())
    viewer.open()
    assert viewer._child is not None
    try:
        viewer._child.kill()
        assert updated_until_it_fails(viewer) == "the page's server died: killed by SIGKILL"
    finally:
        viewer.close()


def test_invalid_messages_of_the_server_are_dropped_and_an_error_while_receiving_ends_the_run(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    viewer = WebViewer(OPTIONS, make_context())
    viewer.open()
    try:
        child: Any = viewer._child
        arrived = [{"event": "pages"}, {"do": "estop"}, {"stop": "1"}, {"command": "operate", "facts": {}}]
        monkeypatch.setattr(child, "receive", lambda: [arrived.pop()] if arrived else [{"alive": True}])
        deadline_s = time.monotonic() + 60
        while arrived and time.monotonic() < deadline_s:
            assert viewer.update()
        assert sum(message.startswith("dropped a message") for message in caplog.messages) >= 3
        monkeypatch.setattr(child, "receive", lambda: 1 / 0)
        assert "the page can no longer stop the robot" in updated_until_it_fails(viewer)
    finally:
        viewer.close()
