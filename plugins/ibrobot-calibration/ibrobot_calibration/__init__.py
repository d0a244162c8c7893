"""Calibrations of arms; `joint_units` converts positions of joints between radians and LeRobot's units."""

from ibrobot_calibration.calibration import ZERO_AT as ZERO_AT
from ibrobot_calibration.calibration import Calibration as Calibration
from ibrobot_calibration.calibration import JointCalibration as JointCalibration
from ibrobot_calibration.calibration import calibration_path as calibration_path
from ibrobot_calibration.calibration import companion_path as companion_path
from ibrobot_calibration.calibration import load_calibration as load_calibration
