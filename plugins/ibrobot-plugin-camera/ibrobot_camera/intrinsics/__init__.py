"""Calibration of a camera's lens with a ChArUco board: board, views of it, and the intrinsics that follow."""
