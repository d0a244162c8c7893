"""Where a camera is mounted, from pictures of a board and the readings of the joints ("hand-eye calibration")."""
