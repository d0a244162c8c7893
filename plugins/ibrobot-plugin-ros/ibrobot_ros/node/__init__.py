"""The ROS node, in a process and an interpreter of its own; it imports nothing but rclpy and core's `Channel`."""
