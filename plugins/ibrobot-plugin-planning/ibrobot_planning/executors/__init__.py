"""The executors of goals: `trajectory` and `gripper`. They run in the control process."""
