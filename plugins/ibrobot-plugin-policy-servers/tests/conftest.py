"""Runs of the fake robot, with the policies of this plugin."""

from fake_runs import runs, site

__all__ = ["runs", "site"]
