"""ibrobot: one robot YAML drives teleoperation, recording, policies, planning and control."""

from ibrobot_core.hookspecs import hookimpl

__all__ = ["__version__", "hookimpl"]

__version__ = "0.1.0"
