"""The control process: loop, safety layer, shared-memory link and the built-in executors."""
