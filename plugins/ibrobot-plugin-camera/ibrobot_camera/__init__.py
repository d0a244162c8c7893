"""Cameras for ibrobot: V4L2 devices, RTSP streams and video files through OpenCV, RealSense as an extra."""
