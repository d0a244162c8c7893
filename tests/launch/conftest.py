"""Every test here has runs of the fake robot."""

from fake_runs import runs

__all__ = ["runs"]
