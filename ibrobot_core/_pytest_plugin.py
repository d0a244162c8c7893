"""Loaded by pytest wherever core is installed: clear assertion messages for the conformance suites."""

import pytest

pytest.register_assert_rewrite("ibrobot_core.testing")
