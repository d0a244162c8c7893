"""A small LeRobot with one robot, one leader and one camera, without motors and torch."""
