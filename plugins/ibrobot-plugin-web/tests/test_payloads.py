"""Payloads between the run and pages: pictures, frames, and JSON of anything that messages contain."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
from types import SimpleNamespace
from typing import Any

import attrs
import numpy as np
import pytest
import simplejpeg
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_ros2.jpeg import to_jpeg
from ibrobot_terminal import PanelDescriptor
from ibrobot_terminal.agent_calls import AgentCalls
from ibrobot_terminal.authority import authority_of
from ibrobot_testing import make_session, stand_in
from ibrobot_web.link import JPEG, PICTURE_HEAD, FrameSender
from ibrobot_web.objects import SceneObjects
from ibrobot_web.pictures import as_jpeg, to_payload
from ibrobot_web.status import LogLines, agents_json, numbers_of, plan_json, status_json

from ibrobot_core.api import (
    Float64MultiArray,
    Header,
    IbrobotError,
    Image,
    Imu,
    JointState,
    Pose,
    Quaternion,
    SceneObject,
    String,
    Vector3,
)
from ibrobot_core.app import Channel, RunView


def gradient(encoding: str) -> Image:
    """A picture that is red on the left and blue on the right, or bright on the left."""
    ramp = np.linspace(1.0, 0.0, 32)[None, :].repeat(16, axis=0)
    rgb = np.stack([ramp, 0 * ramp, 1 - ramp], axis=2)
    data: Any = {
        "rgb8": (255 * rgb).astype(np.uint8),
        "bgr8": (255 * rgb[..., ::-1]).astype(np.uint8),
        "mono8": (255 * ramp).astype(np.uint8),
        "mono16": (65535 * ramp).astype(np.uint16),
        "16UC1": (4000 * (1.01 - ramp)).astype(np.uint16),
        "32FC1": (4 * (1.01 - ramp)).astype(np.float32),
    }[encoding]
    raw = np.ascontiguousarray(data).view(np.uint8).reshape(-1)
    return Image(Header(123), 16, 32, encoding, raw.size // 16, raw)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "mono16", "16UC1", "32FC1"])
def test_pixels_reach_pages_as_jpeg(encoding: str) -> None:
    payload = to_payload(gradient(encoding))
    assert payload is not None
    sent = asyncio.run(as_jpeg(payload))
    stamp_ns, _, _, kind = PICTURE_HEAD.unpack_from(sent)
    assert (stamp_ns, kind) == (123, JPEG)
    shown = simplejpeg.decode_jpeg(sent[PICTURE_HEAD.size :])
    assert shown.shape == (16, 32, 3)
    assert int(shown[8, 2, 0]) > int(shown[8, 29, 0]) + 150


def test_a_jpeg_stays_as_the_camera_made_it() -> None:
    picture = to_jpeg(gradient("rgb8"), 90)
    payload = to_payload(picture)
    assert payload is not None
    assert asyncio.run(as_jpeg(payload)) == payload
    assert payload[PICTURE_HEAD.size :] == picture.data.tobytes()


def test_messages_without_pictures_have_none() -> None:
    assert to_payload(String("hello")) is None


@given(st.lists(st.tuples(st.integers(0, 3), st.binary(max_size=40)), min_size=1, max_size=20))
def test_frames_arrive_in_order_and_the_newest_of_each_channel_arrives(frames: list[tuple[int, bytes]]) -> None:
    near, far = socket.socketpair()
    sender, receiver = FrameSender(near), Channel(far)
    for channel, payload in frames:
        sender.send(channel, payload)
    found = [(frame["channel"], bytes(frame.payload)) for frame in receiver.receive()]
    sender.close()
    receiver.close()
    assert found == frames


def test_a_reader_that_is_behind_gets_the_newest() -> None:
    near, far = socket.socketpair()
    sender, receiver = FrameSender(near), Channel(far)
    for i in range(100):
        sender.send(16, bytes([i]) * 100_000)
    assert sender.replaced > 90
    frames = []
    for _ in range(1000):
        frames += receiver.receive()
        sender.flush()
    assert frames[-1].payload == bytes([99]) * 100_000
    assert len(frames) < 10
    sender.close()
    receiver.close()


def test_numbers_of_messages_are_paths() -> None:
    assert numbers_of(Float64MultiArray(np.array([1.5, np.nan]))) == {"data[0]": 1.5}
    assert numbers_of(String("5")) == {}
    names = numbers_of(JointState(Header(1), ("a", "b"), np.array([1.0, 2.0])))
    assert names == {"position.a": 1.0, "position.b": 2.0}
    assert numbers_of(Float64MultiArray(np.array([1.5, 2.0])), ("a",)) == {"a": 1.5, "data[1]": 2.0}
    assert numbers_of(Imu(Header(1), linear_acceleration=Vector3(0, 0, 9.81)))["linear_acceleration.z"] == 9.81


def test_the_status_of_a_run_is_json_without_nan() -> None:
    session = make_session()
    log = LogLines()
    status = status_json(session, log, AgentCalls(session), 2)
    text = json.dumps(status, allow_nan=False)
    assert json.loads(text)["robot"]["joints"][0]["name"] == "shoulder_pan"
    assert plan_json(session, 0) == {"joints": [], "rows": []}


APART = {"first": "hand", "second": "wall", "distance": 0.0031, "text": "hand was 3.1 mm from wall"}


@pytest.mark.parametrize(
    ("label", "shown"),
    [
        (json.dumps(APART), ["hand", "wall", "hand was 3.1 mm from wall"]),
        ('{"first": "x", "second": "y", "distance": 1}', ['{"first": "x", "second": "y", "distance": 1}']),
        ("something near", ["something near"]), ("[1]", ["[1]"]), ("3", ["3"]), ("", []),
    ],
)  # fmt: skip
def test_the_status_names_what_the_guard_keeps_apart(label: str, shown: list[str]) -> None:
    session = make_session()
    assert status_json(session, LogLines(), AgentCalls(session), 1)["guard"] == {}
    session.bus.publish("/guard", String(label), latched=True)
    assert list(status_json(session, LogLines(), AgentCalls(session), 1)["guard"].values()) == shown


def test_the_status_has_what_an_agent_asked_for_last_that_moves_the_robot() -> None:
    session = make_session()
    agents = AgentCalls(session)
    for service in ("/planning/go_to", "/test/look", "/estop"):
        declared = attrs.evolve(stand_in(service), reads=service == "/test/look", urgent=service == "/estop")
        session.bus.serve(declared, lambda request: 1)
    authority = authority_of(session)
    agent = authority.join("claude")
    nothing = {"connected": ["1:claude"], "armed": "", "left_s": 0, "speed": None, "ended": "", "asked": None}
    authority.call(agent, "/test/look")
    authority.call(agent, "/estop")
    assert agents_json(session, agents) == nothing
    asked = {"agent": "1:claude", "service": "/planning/go_to", "refused": True}
    requests: list[tuple[Any, str]] = [
        ({"goal": "home"}, "home"), ("rest", "rest"), ({"goal": 3}, ""), ([1], ""), (None, ""), ("x" * 900, ""),
        (float("nan"), ""), ({"goal": "<b>ignore all rules</b>"}, "<b>ignore all rules</b>"),
    ]  # fmt: skip
    for request, goal in requests:
        with pytest.raises(IbrobotError, match="may not move the robot"):
            authority.call(agent, "/planning/go_to", request)
        found, text = agents_json(session, agents)["asked"], json.dumps(request)
        more = f" … and {len(text) - 300} characters more" if len(text) > 300 else ""
        assert found == {**asked, "goal": goal, "request": text[:300] + more}
    json.dumps(agents_json(session, agents), allow_nan=False)
    agents.close()
    with pytest.raises(IbrobotError):
        authority.call(agent, "/planning/go_to", "home")
    assert agents_json(session, agents)["asked"] == found


def test_pages_that_only_watch_see_no_token_in_the_log() -> None:
    log = LogLines()
    link = "viewer: http://127.0.0.1:8080/?token=x-Y_z  (to watch only: http://127.0.0.1:8080/?token=abc)"
    log.emit(logging.LogRecord("ibrobot", logging.INFO, "", 0, link, None, None))
    (line,) = log.lines()
    assert line["text"] == "viewer: http://127.0.0.1:8080/?token=…  (to watch only: http://127.0.0.1:8080/?token=…)"


def test_panels_of_plugins_are_shown_and_a_failing_one_harms_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(session: RunView) -> list[list[str]]:
        raise ValueError("no servos")

    session = make_session()

    def panel(title: str, head: str, rows: Any) -> PanelDescriptor:
        return PanelDescriptor(title.lower(), label=title, summary="", columns=(head,), make=rows)

    panels = [
        panel("Joints", "joint", lambda session: [[name] for name in session.config.robot.joint_names[:2]]),
        panel("Nothing_here", "joint", lambda session: []),
        panel("Broken", "servo", fails),
    ]
    monkeypatch.setattr(type(session.registry), "of_kind", lambda self, kind: panels)
    joints, broken = status_json(session, LogLines(), AgentCalls(session), 0)["panels"]
    assert joints == {"title": "Joints", "columns": ["joint"], "rows": [["shoulder_pan"], ["shoulder_lift"]]}
    assert "no servos" in broken["rows"][0][0]


def test_objects_around_the_robot_are_shown_where_they_are() -> None:
    here = Pose(Vector3(1, 2, 3), Quaternion(0, 0, 0, 1))
    things = [SceneObject("crate", "box", (0.2, 0.4, 0.6), here), SceneObject("floor", "plane", (), here)]
    session = make_session()
    session.bus.serve(stand_in("/world/shapes"), lambda request: things)
    (crate,) = SceneObjects(session).json()
    shape = {"type": "box", "size": [0.1, 0.2, 0.3], "pos": [1, 2, 3], "quat": [1, 0, 0, 0], "color": []}
    assert crate == {"name": "crate", **shape}


def test_objects_of_a_simulated_scene_are_where_the_simulation_has_them() -> None:
    here = Pose(Vector3(1, 2, 3), Quaternion(0, 0, 0, 1))
    things = (
        SceneObject("table", "plane", (), here),
        SceneObject("bin", "box", (0.2, 0.4, 0.6), here),
        SceneObject("cube", "box", (0.2, 0.2, 0.2), here, "/simulation/scene", 2, (0.8, 0.1, 0.1234567, 1.0)),
    )
    session = make_session()
    options = SimpleNamespace(scene_objects=lambda robot: things)
    config = SimpleNamespace(simulated=True, simulation=SimpleNamespace(options=options), robot=None)
    objects: Any = SceneObjects(SimpleNamespace(bus=session.bus, config=config))
    assert [(each["name"], each["pos"]) for each in objects.json()] == [("bin", [1, 2, 3]), ("cube", [1, 2, 3])]
    session.bus.publish("/simulation/scene", Float64MultiArray(np.array([9.0, 9.0, 0.5, 0.6, 0.7, 0.0, 1.0, 0.0, 0.0])))
    bin_, cube = objects.json()
    assert (bin_["pos"], bin_["size"]) == ([1, 2, 3], [0.1, 0.2, 0.3])
    assert (bin_["color"], cube["color"]) == ([], [0.8, 0.1, 0.123, 1.0])
    assert (cube["pos"], cube["quat"]) == ([0.5, 0.6, 0.7], [0.0, 1.0, 0.0, 0.0])
    planned = [attrs.evolve(things[2], color=()), SceneObject("crate", "box", (1.0, 1.0, 1.0), here)]
    session.bus.serve(stand_in("/world/shapes"), lambda request: planned)
    colours = {each["name"]: each["color"] for each in objects.json()}
    assert colours == {"cube": cube["color"], "crate": [], "bin": []}, "planners know shapes alone"
    objects.close()
