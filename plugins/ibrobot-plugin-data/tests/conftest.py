"""Every test of this plugin leaves nothing open."""

from ibrobot_testing.leaks import no_leaks  # noqa: F401
