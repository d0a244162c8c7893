"""Topics shared with other machines: both ways, latched ones, a network that hangs or refuses, and what is refused."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import attrs
import pytest
from ibrobot_ros2.services import DETAILS, SERVICES, Answer, Call, decode_answer, encode_call
from ibrobot_testing import stand_in

from ibrobot_core.api import NS_PER_S, Bool, MissingDependency, NotSupported, String, TransportError, option
from ibrobot_core.app import ConfigError, Service

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site


@pytest.fixture
def network(site: Site) -> Any:
    """The module of a plugin with the transport `network`; what it made is in `MADE`."""
    site.add("a-network", "recording_network.py")


def made() -> Any:
    return sys.modules["a_network"].MADE[-1]


def test_what_is_published_goes_out(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {publish: [/joint_states, /note]}}")
    runtime.session.bus.publish("/note", String("kept"), latched=True)
    runtime.session.bus.publish("/secret", String("not shared"))
    for _ in range(5):
        runtime.step()
    sent = made().sent
    assert ("/note", String("kept"), True) in sent
    states = [(message, latched) for topic, message, latched in sent if topic == "/joint_states"]
    assert len(states) >= 4
    assert not any(latched for _, latched in states)
    assert {topic for topic, *_ in sent} == {"/joint_states", "/note"}
    runtime.stop()
    assert made().closed


def test_pictures_of_a_camera_that_cannot_run_here_are_refused(runs: Runs, network: None):
    runs.make()  # imports the parts
    runs.parts.TROUBLE["no OpenGL"] = True
    with pytest.raises(MissingDependency, match=r"transport.share.publish needs camera side: no OpenGL; sudo apt-get"):
        runs.make("transport={type: network, share: {publish: [/camera/side/image_raw]}}", mode="teleop")


def test_a_topic_that_nothing_publishes_is_reported_once(runs: Runs, network: None, caplog: pytest.LogCaptureFixture):
    runtime = runs.start("transport={type: network, share: {publish: [/joint_state, /joint_states]}}")
    while runtime.session.clock.now_ns() < 4 * NS_PER_S:
        runtime.step()
    assert "is not shared" not in caplog.text
    for _ in range(300):
        runtime.step()
    runtime.stop()
    said = "/joint_state is not shared: it has no publisher so far, did you mean '/joint_states'?"
    assert [said] == [record.message for record in caplog.records if "is not shared" in record.message]


def test_a_network_that_refuses_is_reported_once(runs: Runs, network: None, caplog: pytest.LogCaptureFixture):
    runtime = runs.start("transport={type: network, share: {publish: [/joint_states]}}")
    made().refuses = True
    for _ in range(5):
        runtime.step()
    assert caplog.text.count("/joint_states is not shared: the network says no") == 1
    made().refuses = False
    made().sent.clear()
    runtime.step()
    assert made().sent
    runtime.stop()


def test_a_network_that_hangs_costs_counted_messages_only(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {publish: [/note]}}", lockstep=False)
    bus = runtime.session.bus
    made().goes_on.clear()
    for i in range(50):
        bus.publish("/note", String(str(i)))
    assert bus.dropped()["/note"] >= 39
    made().goes_on.set()
    runtime.stop()


def test_what_others_publish_comes_in(runs: Runs, network: None, caplog: pytest.LogCaptureFixture):
    runtime = runs.start("transport={type: network, share: {subscribe: [/lamp]}}", lockstep=False)
    lamp = runtime.session.bus.subscribe("/lamp")
    take = made().callbacks["/lamp"]
    take(Bool(True))
    received = lamp.get(30.0)
    assert received is not None
    assert received.message == Bool(True)
    for _ in range(2):
        take(String("of another type"))
    assert caplog.text.count("topic /lamp carries std_msgs/msg/Bool, not std_msgs/msg/String") == 1
    runtime.stop()
    assert made().callbacks == {}


def test_a_wrong_first_message_keeps_no_right_one_out(runs: Runs, network: None, caplog: pytest.LogCaptureFixture):
    share = "subscribe: {/lamp: std_msgs/msg/Bool}"
    runtime = runs.start(f"transport={{type: network, share: {{{share}}}}}", lockstep=False)
    bus = runtime.session.bus
    seen = bus.subscribe("/lamp")
    made().callbacks["/lamp"](String("first"))
    made().callbacks["/lamp"](Bool(True))
    assert [item.message for item in seen.drain()] == [Bool(True)]
    assert "from another machine: topic /lamp carries std_msgs/msg/Bool, not std_msgs/msg/String" in caplog.text
    assert "nothing declares the type" not in caplog.text
    runtime.stop()


def test_the_contract_states_types_before_anything_is_published(runs: Runs):
    bus = runs.make().session.bus
    assert bus.topics() == {}
    with pytest.raises(TransportError, match="topic /joint_states carries sensor_msgs/msg/JointState, not"):
        bus.publish("/joint_states", String("no state"))


def test_a_topic_of_unknown_type_is_named(runs: Runs, network: None, caplog: pytest.LogCaptureFixture):
    runtime = runs.start("transport={type: network, share: {subscribe: [/lamp]}}", lockstep=False)
    assert "nothing declares the type of /lamp, so its first message will; {/lamp: TYPE} declares it" in caplog.text
    runtime.stop()


def test_nothing_comes_in_in_lockstep(runs: Runs, network: None):
    with pytest.raises(NotSupported, match=r"transport\.share\.subscribe: a lockstep run cannot receive"):
        runs.make("transport={type: network, share: {subscribe: [/lamp]}}", lockstep=True)


def ask(service: str, request: Any = None, raw: bytes | None = None) -> Answer:
    return decode_answer(made().request("services", raw or encode_call(Call(service, request)), 5.0))


def test_only_short_calls_of_urgent_services_overtake_others(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {services: [/estop]}}", lockstep=False)
    is_urgent = made().is_urgent
    assert is_urgent(encode_call(Call("/estop")))
    for other in (Call("/reset"), Call("/nobody"), Call("/estop", "a" * 1000)):
        assert not is_urgent(encode_call(other))
    assert not is_urgent(b"{")
    runtime.stop()


def test_services_answer_other_machines(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {services: [/double, /planning/]}}", lockstep=False)
    runtime.session.bus.serve(stand_in("/double"), lambda request: [request, request])
    runtime.session.bus.serve(stand_in("/secret"), lambda request: "not shared")
    assert ask("/double", {"a": 1}) == Answer([{"a": 1}, {"a": 1}])
    assert ask(SERVICES) == Answer(["/double"])
    runtime.session.bus.serve(stand_in("/planning/go_to"), lambda request: 7)
    assert ask("/planning/go_to", "home") == Answer(7)
    assert ask(SERVICES) == Answer(["/double", "/planning/go_to"])
    assert ask("/secret") == Answer(
        "/secret is not shared; shared: /double, /planning/go_to; transport.share.services of the robot lists what is",
        False,
    )
    assert ask("/doubel").values.startswith("/doubel is not shared, did you mean '/double'?")
    refused = ask("/planning/cancel")
    assert not refused.result
    assert refused.values.startswith("nobody serves /planning/cancel; served: ")
    runtime.stop()
    with pytest.raises(TransportError):
        ask("/double")


@attrs.frozen
class Fold:
    """A request."""

    times: int = option(1, ge=1, unit="folds", help="how often")


@attrs.frozen
class Folded:
    """An answer."""

    thickness: float = option(unit="m", help="of the whole")


def test_a_declaration_is_shown_to_other_machines(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {services: [/paper/]}}", lockstep=False)
    fold = Service("/paper/fold", Fold, Folded, "Fold paper.", alone="times")
    runtime.session.bus.serve(fold, lambda request: Folded(request.times * 1e-4))
    details = ask(DETAILS, "/paper/fold").values
    assert (details["help"], details["alone"], details["answer"]) == ("Fold paper.", "times", "Folded")
    (times,), (thickness,) = details["request"], details["answer_keys"]
    assert (times["name"], times["unit"], times["allowed"], times["help"]) == ("times", "folds", "≥ 1", "how often")
    assert (thickness["name"], thickness["unit"], thickness["help"]) == ("thickness", "m", "of the whole")
    assert ask(DETAILS, "/secret").values.startswith("/secret is not shared")
    assert ask(DETAILS, "/paper/cut").values == "nothing serves /paper/cut at present; served are /paper/fold"
    runtime.stop()


@pytest.mark.parametrize(
    ("raw", "told"),
    [
        (b"{", "not JSON: "),
        (b"[]", "expected a JSON object, got list"),
        (b'{"op": "publish"}', "not a service call: it needs op: call_service and the name of a service"),
        (b"[" * 100_000, "not JSON: "),
    ],
)
def test_bytes_that_are_no_call_are_refused(runs: Runs, network: None, raw: bytes, told: str):
    runtime = runs.start("transport={type: network, share: {services: [/double]}}", lockstep=False)
    runtime.session.bus.serve(stand_in("/double"), lambda request: request)
    refused = ask("", raw=raw)
    assert not refused.result
    assert refused.values.startswith(told)
    runtime.stop()


def test_answer_that_is_no_data_is_refused(runs: Runs, network: None):
    runtime = runs.start("transport={type: network, share: {services: [/runtime]}}", lockstep=False)
    runtime.session.bus.serve(stand_in("/runtime"), lambda request: runtime)
    assert ask("/runtime") == Answer("a Runtime cannot be sent to another process", False)
    runtime.stop()


def test_nothing_is_answered_in_lockstep(runs: Runs, network: None):
    with pytest.raises(NotSupported, match=r"transport\.share\.services: a lockstep run cannot answer"):
        runs.make("transport={type: network, share: {services: [/lamp]}}", lockstep=True)


@pytest.mark.parametrize(
    ("transport", "expected"),
    [
        ("{type: local, share: {publish: [/a]}}", "unknown key"),
        ("{type: network, share: {publish: [a]}}", "'a' is not a full topic name, did you mean '/a'?"),
        ("{type: network, share: {publish: [/a, /a]}}", "/a is listed twice"),
        ("{type: network, share: {publish: [/a], subscribe: [/a]}}", "/a is both published and subscribed"),
        ("{type: network, share: {publish: [/a], subscribe: {/a: std_msgs/msg/Bool}}}", "/a is both published and"),
        ("{type: network, share: {subscribe: {a: std_msgs/msg/Bool}}}", "'a' is not a full topic name"),
        (
            "{type: network, share: {subscribe: {/a: std_msgs/msg/Boo}}}",
            "/a: unknown message type 'std_msgs/msg/Boo'",
        ),
        ("{type: network, share: {services: [a]}}", "'a' is not a full name of a service, did you mean '/a'?"),
        ("{type: network, share: {services: [/a, /a]}}", "/a is listed twice"),
        ("{type: network, share: {publishes: [/a]}}", "did you mean 'publish'?"),
    ],
)
def test_mistakes_in_the_yaml(transport: str, expected: str, runs: Runs, network: None):
    with pytest.raises(ConfigError, match=expected.replace("?", r"\?")):
        runs.make(f"transport={transport}")
