"""Inference: from frames to chunks of actions, wherever the model runs."""
