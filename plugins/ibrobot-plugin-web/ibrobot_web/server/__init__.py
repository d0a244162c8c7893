"""The server of the page, in a process of its own."""
