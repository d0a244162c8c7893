"""Recording: where episodes are kept, and what is written beside their messages."""
