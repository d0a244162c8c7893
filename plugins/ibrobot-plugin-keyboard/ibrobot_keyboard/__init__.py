"""Jog a robot from the terminal: joint and Cartesian teleoperation for ibrobot."""
