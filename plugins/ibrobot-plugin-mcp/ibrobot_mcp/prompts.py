"""Prompts for the usual work."""

from __future__ import annotations

from collections.abc import Mapping

import mcp_types as types

from ibrobot_core.app import RequestError

_TEXTS: Mapping[str, tuple[str, str, str]] = {
    "pick": (
        "Pick up an object.",
        "object",
        "Pick up the object named {object!r}. Call `state`, `look` and `world`. Plan with `plan_to` above the object "
        "and then at it, with the gripper open; tell me what will move before you move. Go there with `move`, close "
        "with `gripper`, lift, and `look` whether you have it. Stop and tell me if anything is refused.",
    ),
    "look_around": (
        "Say what the robot sees.",
        "",
        "Call `state`, `world` and `look`, and tell me what you see, where it is in metres in the robot's base frame, "
        "and what the robot could do with it. Move nothing.",
    ),
    "try_policy": (
        "Run a policy, and say whether it succeeds.",
        "mode",
        "Call `state` and `look`. Run the policy of mode {mode!r} by `run_policy`, until it succeeds and for 30 "
        "seconds at most, with `record_episode` before and `end_episode` after it if there are such tools. `look` "
        "again, and tell me what happened. If it failed, call `explain` with the episode.",
    ),
    "evaluate": (
        "Count how often a policy succeeds in simulation.",
        "mode",
        "Call `evaluate` with mode {mode!r} and 20 episodes, and `wait` for its result. Tell me the successes with "
        "their interval, and which episodes failed. Ask me for the authority if it is refused.",
    ),
    "why_failed": (
        "Say why a recorded run failed, and what to do about it.",
        "episode",
        "Call `explain` for the episode {episode!r}, of those in ibrobot://episodes, and `wait` for its result. Tell "
        "me the most probable cause with its number, and what to do, in a few sentences.",
    ),
}
"""Name -> what it is for, its argument, and its text."""
PROMPTS = tuple(
    types.Prompt(
        name=name,
        description=about,
        arguments=[types.PromptArgument(name=argument, required=True)] if argument else [],
    )
    for name, (about, argument, _) in _TEXTS.items()
)


def prompt(name: str, arguments: Mapping[str, str]) -> str:
    """The text of a prompt.

    Raises:
        RequestError: for an unknown prompt or a missing argument.
    """
    if name not in _TEXTS:
        raise RequestError(f"there is no prompt {name[:80]!r}; the prompts are: {', '.join(_TEXTS)}")
    _, argument, text = _TEXTS[name]
    if argument and not arguments.get(argument):
        raise RequestError(f"prompt {name}: give the argument {argument}")
    return text.format(**{argument: str(arguments[argument])[:200]} if argument else {})
