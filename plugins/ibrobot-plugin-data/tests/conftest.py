"""Runs of the fake robot, and episodes without any other plugin."""

from fake_runs import runs, site

__all__ = ["runs", "site"]
