"""Published parameters of servos, for `simulation.parameters`."""
