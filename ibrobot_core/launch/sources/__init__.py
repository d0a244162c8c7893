"""Command sources: a policy, a teleoperation device or a planner commands the executors of a mode."""
