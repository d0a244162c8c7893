"""What shows or publishes a run: status, transforms, metrics, shared topics, the viewer."""
