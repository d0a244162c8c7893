"""Loaded by pytest wherever ibrobot-testing is installed: the fixture `no_leaks`."""

from ibrobot_testing.leaks import no_leaks

__all__ = ["no_leaks"]
