"""Jobs and pools, their questions, the code that results depend on, and folders with one owner."""
