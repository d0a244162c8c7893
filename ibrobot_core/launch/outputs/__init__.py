"""Outputs of a run: status, shared topics, the viewer."""
