"""What the YAML text and single values may be: syntax, keys, types, ranges, plugin types."""

from __future__ import annotations

from collections.abc import Callable

import pytest

# The fault, the replaced text of the base YAML, its replacement, and the whole error.
CASES = {
    "unknown_section": (
        "recording: {type",
        "recordings: {type",
        "robot.yaml:40: recordings: unknown key, did you mean 'recording'?",
    ),
    "unknown_option": (
        "port: /dev/null}",
        "port: /dev/null, max_sped: 2.0}",
        "robot.yaml:12: hardware.max_sped: unknown key, did you mean 'max_speed'?",
    ),
    "unknown_option_far": (
        "port: /dev/null}",
        "port: /dev/null, zzz: 2.0}",
        (
            "robot.yaml:12: hardware.zzz: unknown key; known keys: type, joints, port, max_speed, baud, torque, "
            "calibration, parity"
        ),
    ),
    "missing_option": (
        "hardware: {type: bus, port: /dev/null}",
        "hardware: {type: bus}",
        "robot.yaml:12: hardware.port: required key is missing",
    ),
    "missing_section": (
        "default_control_mode: teleop\n",
        "",
        "robot.yaml: default_control_mode: required key is missing",
    ),
    "missing_type": (
        "stick: {type: stick}",
        "stick: {}",
        "robot.yaml:31: teleoperation.stick.type: required key is missing",
    ),
    "misspelt_type_key": (
        "stick: {type: stick}",
        "stick: {tpye: stick}",
        "robot.yaml:31: teleoperation.stick.tpye: unknown key, did you mean 'type'?",
    ),
    "unknown_type": (
        "stick: {type: stick}",
        "stick: {type: stik}",
        "robot.yaml:31: teleoperation.stick.type: unknown teleop type 'stik', did you mean 'stick'?",
    ),
    "missing_plugin": (
        "stick: {type: stick}",
        "stick: {type: keyboard}",
        (
            "robot.yaml:31: teleoperation.stick.type: teleop type 'keyboard' needs a plugin that is not "
            "installed: pip install ibrobot-plugin-keyboard"
        ),
    ),
    "missing_plugin_sim": (
        "simulation: {type: world}",
        "simulation: {type: world}\nviewer: {type: mujoco}",
        (
            "robot.yaml:14: viewer.type: viewer type 'mujoco' needs a plugin that is not installed: pip install "
            "ibrobot-plugin-mujoco"
        ),
    ),
    "component_is_text": (
        "stick: {type: stick}",
        "stick: keyboard",
        "robot.yaml:31: teleoperation.stick: expected a mapping, got 'keyboard'",
    ),
    "number_as_text": (
        "rate_hz: 30",
        "rate_hz: fast",
        "robot.yaml:33: contract.rate_hz: expected a number, got 'fast'",
    ),
    "quoted_number": (
        "rate_hz: 30",
        "rate_hz: '30'",
        "robot.yaml:33: contract.rate_hz: expected a number, got '30'",
    ),
    "fraction_for_int": (
        "port: /dev/null}",
        "port: /dev/null, baud: 9600.5}",
        "robot.yaml:12: hardware.baud: expected a whole number, got 9600.5",
    ),
    "bool_for_int": (
        "port: /dev/null}",
        "port: /dev/null, baud: true}",
        "robot.yaml:12: hardware.baud: expected a whole number, got true",
    ),
    "bool_for_float": (
        "port: /dev/null}",
        "port: /dev/null, max_speed: false}",
        "robot.yaml:12: hardware.max_speed: expected a number, got false",
    ),
    "text_bool": (
        "port: /dev/null}",
        'port: /dev/null, torque: "false"}',
        (
            "robot.yaml:12: hardware.torque: expected true or false, got 'false' (only true and false, unquoted, "
            "are truth values)"
        ),
    ),
    "yaml11_bool": (
        "port: /dev/null}",
        "port: /dev/null, torque: on}",
        (
            "robot.yaml:12: hardware.torque: expected true or false, got 'on' (only true and false, unquoted, "
            "are truth values)"
        ),
    ),
    "number_for_text": (
        "port: /dev/null}",
        "port: 5}",
        "robot.yaml:12: hardware.port: expected text, got 5 (quote it: '5')",
    ),
    "null_for_text": (
        "port: /dev/null}",
        "port: }",
        "robot.yaml:12: hardware.port: expected text, got nothing",
    ),
    "too_small": (
        "port: /dev/null}",
        "port: /dev/null, baud: 300}",
        "robot.yaml:12: hardware.baud: 300 is too small, must be at least 9600 Bd",
    ),
    "too_large": (
        "stop: hold}",
        "stop: hold, priority: 100}",
        "robot.yaml:41: control.priority: 100 is too large, must be at most 99",
    ),
    "infinite": (
        "port: /dev/null}",
        "port: /dev/null, max_speed: .inf}",
        "robot.yaml:12: hardware.max_speed: inf is not a finite number",
    ),
    "nan": (
        "port: /dev/null}",
        "port: /dev/null, max_speed: .nan}",
        "robot.yaml:12: hardware.max_speed: nan is too small, must be above 0 rad/s",
    ),
    "literal": (
        "port: /dev/null}",
        "port: /dev/null, parity: odd}",
        "robot.yaml:12: hardware.parity: 'odd' is not one of: none, even",
    ),
    "union": (
        "net: {type: net}",
        "net: {type: net, scale: [1]}",
        "robot.yaml:22: models.net.scale: expected a number or text, got a list",
    ),
    "pair_length": (
        "net: {type: net}",
        "net: {type: net, gains: [1.0]}",
        "robot.yaml:22: models.net.gains: expected a list of 2 values, got 1",
    ),
    "list_item": (
        "net: {type: net}",
        "net: {type: net, layers: [64, 64.5]}",
        "robot.yaml:22: models.net.layers.1: expected a whole number, got 64.5",
    ),
    "text_for_list": (
        "arm: [pan, lift]",
        "arm: pan",
        "robot.yaml:8: robot.groups.arm: expected a list, got 'pan'",
    ),
    "list_for_mapping": (
        "control: {rate_hz: 100, stop: hold}",
        "control: [100]",
        "robot.yaml:41: control: expected a mapping, got a list",
    ),
    "repeated_key": (
        "control: {rate_hz: 100, stop: hold}",
        "control: {rate_hz: 100, stop: hold}\nrobot: {}",
        "robot.yaml:42: robot: repeated key, first given in line 1",
    ),
    "repeated_inner_key": (
        "port: /dev/null}",
        "port: /dev/null, port: /dev/zero}",
        "robot.yaml:12: hardware.port: repeated key, first given in line 12",
    ),
    "bad_yaml": (
        "arm: [pan, lift]",
        "arm: [pan, lift",
        "robot.yaml:9: not valid YAML: expected ',' or ']', but got ':'",
    ),
    "tag": (
        "rate_hz: 30",
        "rate_hz: !!float 30",
        "robot.yaml:33: contract.rate_hz: unknown tag !!float; remove it",
    ),
    "two_documents": (
        "control: {rate_hz: 100, stop: hold}",
        "control: {rate_hz: 100, stop: hold}\n---\na: 1",
        "robot.yaml:42: not valid YAML: expected a single document in the stream, but found another document",
    ),
    "env_unset": (
        "port: /dev/null}",
        'port: "${IBROBOT_NO_SUCH}"}',
        (
            "robot.yaml:12: hardware.port: environment variable IBROBOT_NO_SUCH is not set; set it, or give a "
            "default: ${IBROBOT_NO_SUCH:value}"
        ),
    ),
    "env_ill_formed": (
        "port: /dev/null}",
        'port: "${9}"}',
        "robot.yaml:12: hardware.port: malformed variable in '${9}'; write ${NAME} or ${NAME:default}",
    ),
    "null_section": (
        "recording: {type: log}",
        "recording:",
        "robot.yaml:40: recording: expected a mapping, got nothing",
    ),
    "null_control": (
        "control: {rate_hz: 100, stop: hold}",
        "control:",
        "robot.yaml:41: control: expected a mapping, got nothing",
    ),
    "null_component": (
        "  stick: {type: stick}",
        "  stick:",
        "robot.yaml:31: teleoperation.stick: expected a mapping, got nothing",
    ),
    "null_simulation": (
        "simulation: {type: world}",
        "simulation:",
        "robot.yaml:13: simulation: expected a mapping, got nothing",
    ),
    "alias": (
        "control: {rate_hz: 100, stop: hold}",
        "control: &a {rate_hz: 100, stop: hold, more: *a}",
        (
            "robot.yaml:41: control.more: an alias to the block that contains it\n"
            "robot.yaml:41: control.more: unknown key; known keys: rate_hz, startup, stop, priority, state_timeout, "
            "peer_timeout, stop_time, following_error, load_shedding, guard"
        ),
    ),
    "merge_of_list": (
        "control: {rate_hz: 100, stop: hold}",
        "control: {<<: 5, stop: hold}",
        "robot.yaml:41: control: << takes an alias to a mapping, or a list of them",
    ),
    "complex_key": (
        "control: {rate_hz: 100, stop: hold}",
        "control: {[a]: 5, stop: hold}",
        "robot.yaml:41: control: a key must be a single word",
    ),
    "several_at_once": (
        "rate_hz: 30",
        "rate_hz: thirty\n  rate: 30",
        (
            "robot.yaml:33: contract.rate_hz: expected a number, got 'thirty'\n"
            "robot.yaml:34: contract.rate: unknown key, did you mean 'rate_hz'?"
        ),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_message(case: str, faults_of_edit: Callable[[str, str], str]) -> None:
    old, new, expected = CASES[case]

    assert faults_of_edit(old, new) == expected
