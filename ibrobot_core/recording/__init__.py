"""Recording: datasets, episodes, their metadata, and the worker that writes them."""
