"""Dispatch: keeps the plan filled with chunks, and smooth."""
