"""Fixtures of this plugin's tests."""

from __future__ import annotations

from ibrobot_testing.leaks import no_leaks  # noqa: F401
