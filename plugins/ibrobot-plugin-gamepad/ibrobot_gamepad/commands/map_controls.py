"""`ibrobot gamepad map`: learns the assignment of controls, and prints it for the robot YAML."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import attrs

from ibrobot_core.api import option
from ibrobot_core.app import dump_yaml, echo, find_config, installed_plugins, load_config
from ibrobot_gamepad.commands.devices import OnDevice, opened, watch
from ibrobot_gamepad.controls import Controls
from ibrobot_gamepad.devices import Device, Found
from ibrobot_gamepad.options import FUNCTIONS, TOOL_AXES

_MOVED = 0.6
"""Deflection from rest beyond which an axis counts as chosen."""
_WAYS = {
    "x": "forward",
    "y": "to the left",
    "z": "up",
    "roll": "turned about where it points",
    "pitch": "down",
    "yaw": "sideways",
}
_PRESSES = {
    "deadman": "that must be held for anything to move", "toggle": "that changes between joints and tool",
    "gripper_open": "or trigger that opens the gripper", "gripper_close": "or trigger that closes it",
    "gripper": "that opens and closes it in turns", "estop": "of the emergency stop", "start": "that begins an episode",
    "success": "that ends one as a success", "failure": "that ends one as a failure",
    "discard": "that ends one and keeps nothing",
    "intervention": "that takes the robot from the policy",
}  # fmt: skip


_Find = Callable[[Controls, Controls], str | None]
"""State and state at rest -> the chosen control."""


@attrs.frozen(kw_only=True)
class MapControls(OnDevice):
    """Learn the controls of a device, and print them as YAML.

    The YAML is for the section `teleoperation`.

    CONFIG is a robot YAML as for `ibrobot launch`; it names the joints. The command asks for one control after another:
    press it, or move it to its end, then let go. A function whose control you do not touch in time keeps its default.
    """

    config: str | None = option(None, typed="CONFIG", names="robot", help="robot YAML")
    wait: float = option(5.0, ge=0, unit="s", help="time for each control")

    def __call__(self) -> None:
        registry = installed_plugins()
        robot = load_config(find_config(self.config, registry), registry=registry).robot
        with opened(self.device) as (kind, listed, open_device):
            echo(f"{listed.name} ({listed.id}): let go of all controls")
            learner = _Learner(open_device, self.wait)
            joints = {
                name: f"Move what moves {name} towards its upper limit"
                for name in robot.joint_names
                if name not in robot.groups.get("gripper", ())
            }
            learned = {
                "joints": learner.axes(joints),
                "tool": learner.axes({axis: f"Move what moves the tool {_WAYS[axis]} ({axis})" for axis in TOOL_AXES}),
                "buttons": learner.buttons({name: f"Press the button {_PRESSES[name]} ({name})" for name in FUNCTIONS}),
            }
        echo("")
        echo(dump_yaml({"teleoperation": {kind: _section(kind, listed, learned)}}).rstrip())


def _section(kind: str, listed: Found, learned: Mapping[str, Mapping[str, str]]) -> dict[str, object]:
    device = f"{listed.vendor:04x}:{listed.product:04x}"
    return {"type": kind, "device": device, **{name: dict(pairs) for name, pairs in learned.items() if pairs}}


class _Learner:
    """Asks for controls, one after another."""

    def __init__(self, device: Device, wait_s: float) -> None:
        self._device = device
        self._wait_s = wait_s
        self._rest: Controls | None = None
        watch(device, wait_s, self._settle)

    def _settle(self, controls: Controls) -> bool:
        self._rest = controls
        return True

    def axes(self, questions: Mapping[str, str]) -> dict[str, str]:
        """Name -> the axis that the operator moved, with a `-` where it went down."""
        return self._ask(questions, self._moved)

    def buttons(self, questions: Mapping[str, str]) -> dict[str, str]:
        """Name -> the button that the operator pressed, or the axis."""
        return self._ask(questions, self._pressed)

    def _ask(self, questions: Mapping[str, str], find: _Find) -> dict[str, str]:
        learned: dict[str, str] = {}
        for name, question in questions.items():
            answer: list[str] = []

            def see(controls: Controls, answer: list[str] = answer) -> bool:
                if self._rest is None:
                    return not self._settle(controls)
                control = find(controls, self._rest)
                answer += [control] if control is not None else []
                return control is not None

            echo(f"{question}:", nl=False)
            watch(self._device, self._wait_s, see)
            echo(f" {answer[0]}" if answer else " default")
            if answer:
                learned[name] = answer[0]
                watch(self._device, self._wait_s, lambda controls: self._find_any(controls) is None)  # let go
        return learned

    def _find_any(self, controls: Controls) -> str | None:
        assert self._rest is not None
        return self._pressed(controls, self._rest) or self._moved(controls, self._rest)

    @staticmethod
    def _moved(controls: Controls, rest: Controls) -> str | None:
        ways = {name: value - rest.axes.get(name, 0.0) for name, value in controls.axes.items()}
        name = max(ways, key=lambda each: abs(ways[each]), default=None)
        if name is None or abs(ways[name]) < _MOVED:
            return None
        return name if ways[name] > 0 else f"-{name}"

    @staticmethod
    def _pressed(controls: Controls, rest: Controls) -> str | None:
        pressed = sorted(controls.buttons - rest.buttons)
        moved = _Learner._moved(controls, rest)
        pulled = moved if moved is not None and not moved.startswith("-") else None
        return pressed[0] if pressed else pulled
