"""The built-in executors: `position`, `trajectory` and `gripper`."""
