"""What turns a checked config into the components of a run; one file for each part of the robot YAML."""
