"""What shows or publishes a run: status, shared topics, the viewer."""
