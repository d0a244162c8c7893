"""What gives the executors of a mode something to do: a policy, a teleoperation device, a planner, a replay."""
