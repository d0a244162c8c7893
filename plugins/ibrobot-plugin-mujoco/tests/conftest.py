"""Fixtures of this plugin's tests."""

from __future__ import annotations

from ibrobot_core.testing.leaks import no_leaks  # noqa: F401
