"""Joint-space motion planning for ibrobot."""
