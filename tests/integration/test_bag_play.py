"""A run takes no topic of its own from the network, so that a played bag cannot command its joints."""

from __future__ import annotations

import pytest
from command_line import run_here


@pytest.mark.parametrize("topic", ["/arm_position_controller/commands", "/joint_states"])
def test_run_takes_no_topic_of_its_own_from_the_network(topic: str) -> None:
    shared = f"transport={{type: zenoh, listen: [tcp/127.0.0.1:7447], share: {{subscribe: [{topic}]}}}}"
    refused = run_here("config", "check", "so101", "--sim", "--set", shared)
    assert refused.returncode == 2
    assert topic in refused.stderr
