"""Actions of IB-Robot, sent by a client of rclpy's."""

from __future__ import annotations

import pytest

from .conftest import Peer, until

RECORD = {"action": "/record_episode", "type": "ibrobot_msgs/action/RecordEpisode"}
TRIGGER = "std_srvs/srv/Trigger"


@pytest.fixture
def recording(start):
    run = start("recording={type: mcap, topics: all}", by_operator=True)
    until(lambda: not run.session.bus.call("/record_episode/status").silent)
    return run


def test_an_episode_is_recorded_until_its_client_cancels(recording, peer, tmp_path):
    episode = tmp_path / "episodes/default/episodes/episode_000001"
    outcome = peer.ask("send", **RECORD, request={"prompt": "pick"}, after_s=1.2, then="cancel")
    assert (outcome["status"], outcome["success"]) == ("CANCELED", True)
    assert outcome["message"].endswith("episodes/default/episodes/episode_000001")
    assert outcome["feedback"] >= 1
    assert episode.is_dir()
    assert recording.session.episodes.prompt == "pick"


def test_the_cancel_service_of_ib_robot_ends_it_as_a_success(recording, peer, peers):
    peers.append(Peer())
    peer.send("send", **RECORD, request={"prompt": "pick"})
    until(lambda: recording.session.episodes.running)
    refused = peers[1].ask("send", **RECORD, request={"prompt": "again"})
    assert (refused["status"], refused["success"]) == ("ABORTED", False)
    assert "an episode is being recorded" in refused["message"]
    assert peers[1].ask("call", name="/record_episode/cancel", type=TRIGGER) == [[True, ""]]
    outcome = peer.answer()
    assert (outcome["status"], outcome["success"]) == ("SUCCEEDED", True)
    ((told, info),) = peers[1].ask("call", name="/record_episode/get_info", type=TRIGGER)
    assert told
    assert '"episodes": 1' in info


def test_what_is_discarded_or_cannot_begin_is_aborted(recording, peer):
    peer.send("send", **RECORD, request={})
    until(lambda: recording.session.episodes.running)
    recording.session.bus.call("/record_episode/discard")
    outcome = peer.answer()
    assert (outcome["status"], outcome["success"], outcome["message"]) == ("ABORTED", False, "episode 1 was discarded")
    recording.session.bus.call("/estop")
    until(lambda: recording.session.faults)
    outcome = peer.ask("send", **RECORD, request={})
    assert (outcome["status"], "reset it first" in outcome["message"]) == ("ABORTED", True)


def test_chunks_of_the_model_that_acts(start, peer):
    run = start(mode="policy")
    infer = {"action": "/act_inference_node/DispatchInfer", "type": "ibrobot_msgs/action/DispatchInfer"}
    outcome = peer.ask("send", **infer, request={"inference_id": "one"})
    ((key, kind, (count, joints), values),) = outcome["action_chunk"]
    assert (outcome["status"], outcome["success"]) == ("SUCCEEDED", True)
    assert (key, kind, joints, outcome["chunk_size"]) == ("action", "float_64_array", 4, count)
    assert values == count * joints
    assert "pan, lift, roll, grip" in outcome["message"]
    run.runtime.switch_mode("idle")
    outcome = peer.ask("send", **infer, request={})
    assert (outcome["status"], outcome["message"], outcome["action_chunk"]) == (
        "ABORTED",
        "no model acts in mode idle",
        [],
    )
