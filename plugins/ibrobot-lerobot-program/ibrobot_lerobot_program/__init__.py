"""A run of ibrobot under a program of LeRobot's: for `lerobot_robot_ibrobot` and `lerobot_teleoperator_ibrobot`."""
