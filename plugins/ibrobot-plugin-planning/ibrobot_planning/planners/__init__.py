"""The planners `joint` and `rrt_connect`: search, timing, and changes between motions."""
