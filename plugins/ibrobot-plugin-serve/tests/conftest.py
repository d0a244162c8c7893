"""Runs of the fake robot, with engines of this plugin."""

from fake_runs import runs, site

from .client_requests import broken, model

__all__ = ["broken", "model", "runs", "site"]
