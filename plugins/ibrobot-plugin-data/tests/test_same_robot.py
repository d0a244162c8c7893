"""Whether two episodes are of the same robot, as far as they say."""

from __future__ import annotations

import json

import pytest
from ibrobot_data.same_robot import Identity

PAN = {"offset": 3, "lower": 100, "upper": 900}
THIS = Identity("left", "so101_follower", {"pan": PAN})


@pytest.mark.parametrize(
    ("other", "text"),
    [
        (Identity("right", "so101_follower", {"pan": PAN}), "its robot is 'right', that of the dataset is 'left'"),
        (Identity("left", "koch"), "its robot_type is 'koch', that of the dataset is 'so101_follower'"),
        (
            Identity("left", "so101_follower", {"pan": {**PAN, "offset": 4}}),
            "its calibration of pan is not that of the dataset: pan has offset 4, lower 100, upper 900, "
            "the dataset has offset 3, lower 100, upper 900",
        ),
        (THIS, ""),
        (Identity(), ""),
        (Identity("left", "so101_follower", {"pan": {**PAN, "closed_at": "lower"}}), ""),
        (Identity("left", "so101_follower", {"lift": PAN}), ""),
    ],
)
def test_a_difference_names_both_sides(other: Identity, text: str) -> None:
    assert THIS.difference(other, "the dataset") == text


def test_the_identity_of_an_episode() -> None:
    calibration = json.dumps({"hardware": {"pan": PAN}})
    metadata = {"robot": "left", "robot_type": "so101_follower", "calibration": calibration}
    assert Identity.of_episode(metadata) == THIS


@pytest.mark.parametrize("calibration", ["no JSON", "[1]", '{"hardware": 3}', "null"])
def test_a_calibration_of_another_program_is_ignored(calibration: str) -> None:
    assert Identity.of_episode({"calibration": calibration}) == Identity()
