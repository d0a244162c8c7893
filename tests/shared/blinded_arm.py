"""The emulated arm of blinded trials, with two policies; needs the plugin `reaching_arm.py`."""

NAMES = ("careful", "hasty")
ARM = """
robot:
  name: mini
  joints:
    - {name: pan, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}
    - {name: lift, lower: -3.0, upper: 3.0, max_velocity: 3.0, max_acceleration: 40.0}
  groups: {arm: [pan, lift]}
hardware: {type: made_up_arm}
executors:
  arm_position: {type: position, group: arm}
models:
  model_one: {type: reaching}
  model_two: {type: reaching}
control_modes:
  careful: {executors: [arm_position], inference: {model: model_one}}
  hasty: {executors: [arm_position], inference: {model: model_two}}
default_control_mode: careful
contract:
  rate_hz: 30
  max_duration_s: 3600
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan, position.lift]}
  actions:
    - {executor: arm_position, topic: /arm/commands}
control: {rate_hz: 100, stop: hold}
"""
