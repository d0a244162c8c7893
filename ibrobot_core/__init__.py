"""ibrobot: one robot YAML drives teleoperation, recording, policies, planning and control."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ibrobot_core.hookspecs import hookimpl

__all__ = ["__version__", "hookimpl"]

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    """Import `hookimpl` on first use, so that the command starts without imports; see `cli.command`."""
    if name == "hookimpl":
        from ibrobot_core.hookspecs import hookimpl

        return hookimpl
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
