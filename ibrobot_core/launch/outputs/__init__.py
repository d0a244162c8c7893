"""What shows or publishes a run: status, transforms, shared topics, the viewer."""
