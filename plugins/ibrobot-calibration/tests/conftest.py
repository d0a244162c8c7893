"""Runs of the fake robot."""

from fake_runs import runs, site

__all__ = ["runs", "site"]
