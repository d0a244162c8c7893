"""Names in recordings and beside policies that several packages write and read."""

from __future__ import annotations

COMMANDER = "/commander"
"""Topic (std_msgs/msg/String) with who commands the robot at each state of control, in modes with `intervene`."""
POLICY, OPERATOR, HANDOVER = "policy", "operator", "handover"
"""The words on `COMMANDER`; in a handover nobody commands, and the arm holds."""
GUARD = "/guard"
"""Topic (std_msgs/msg/String) with what the guard of control kept apart."""
TRIMMED_FROM = "trimmed_from"
"""Key of the metadata of a part of an episode: the recordings that contain it, newest last, by UUID or digest."""
CARD = "reference.json"
"""Name of the card of a policy's data, in the folder of a checkpoint or a dataset."""
ATTENTION = "attention."
"""Prefix of outputs that say what a network attends to in an image, of shape (h, w)."""
