"""Sections and options with a `type`, which selects a plugin; imports nothing heavy, for the options of plugins."""

from __future__ import annotations

import builtins
from typing import Any, ClassVar, get_args

import attrs

from ibrobot_core.options import documented, not_a_key, option


@documented
@attrs.frozen
class ComponentConfig:
    """A section with a `type`, which selects a plugin, and the options of the plugin."""

    plugin_kind: ClassVar[str] = ""
    """The kind of plugins for its types."""
    may_be_alone: ClassVar[bool] = False
    """Whether the section may be a single component instead of named components."""
    simulates: ClassVar[bool] = False
    """Whether hardware in this section is simulated."""

    type: str = option(help="type of plugin, one of those installed")
    options: Any = not_a_key()
    """An instance of the plugin's options class."""

    @classmethod
    def __attrs_init_subclass__(cls) -> None:
        documented(cls)

    @staticmethod
    def within(kind: Any) -> builtins.type[ComponentConfig] | None:
        """The component class in a type annotation: that of a section, or of each of its items."""
        members = (kind, *get_args(kind))
        return next((each for each in members if isinstance(each, type) and issubclass(each, ComponentConfig)), None)

    @classmethod
    def type_key(cls) -> str:
        """The key that names the plugin."""
        return str(attrs.fields(cls).type.alias)


@attrs.frozen
class NamedComponentConfig(ComponentConfig):
    """One of several named components."""

    name: str = not_a_key()
