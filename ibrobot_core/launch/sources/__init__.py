"""Command sources: a policy, a teleoperation device, a planner or a replay commands the executors of a mode."""
