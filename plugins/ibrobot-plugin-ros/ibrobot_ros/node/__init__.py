"""The ROS node, which runs in a process and an interpreter of its own; it imports nothing but rclpy and `wire`."""
