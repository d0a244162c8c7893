"""Joint logs for ibrobot: record them to CSV, replay them, and NPZ datasets."""
