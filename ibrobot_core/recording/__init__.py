"""The life of an episode: begun, written, ended, with its metadata."""
