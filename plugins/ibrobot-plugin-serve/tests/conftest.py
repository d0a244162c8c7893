"""Runs of the fake robot, with engines of this plugin."""

from fake_runs import runs, site

from .client_requests import broken, model
from .served_fleet import fleet

__all__ = ["broken", "fleet", "model", "runs", "site"]
