"""LeRobot datasets for ibrobot: episodes to LeRobot v3 and back, without torch."""
