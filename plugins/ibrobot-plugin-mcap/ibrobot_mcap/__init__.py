"""Records ibrobot's episodes as rosbag2 directories with MCAP files."""
