"""`ibrobot config schema`: a JSON Schema (draft 2020-12) of the robot YAML for editors, with the plugins' options."""

from __future__ import annotations

import json
from typing import Any, get_args, override

import attrs
from ibrobot_provenance.option_schemas import OptionSchemas, Schema

from ibrobot_core.app import (
    ComponentConfig,
    Registry,
    RobotConfig,
    echo,
    fields,
    installed_plugins,
)


@attrs.frozen
class PrintSchema:
    """Print a JSON Schema of robot YAMLs, for editors.

    It has the options of every installed plugin.
    """

    def __call__(self) -> None:
        echo(json.dumps(json_schema(installed_plugins()), indent=2))


def json_schema(registry: Registry) -> Schema:
    """The schema of the whole file."""
    schemas = _Schemas(registry)
    schema = schemas.of_fields(RobotConfig.sections())
    for name in registry.types("section"):
        section = registry.find("section", name)
        schema["properties"][name] = {**schemas.of_fields(fields(section.options)), "description": section.summary}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "ibrobot robot YAML", **schema}


class _Schemas(OptionSchemas):
    """Type annotations -> schemas, with the options of the plugins that a section's `type` chooses from."""

    def __init__(self, registry: Registry) -> None:
        super().__init__()
        self.registry = registry

    @override
    def of_class(self, kind: type[Any]) -> Schema:
        return self._of_component(kind) if issubclass(kind, ComponentConfig) else super().of_class(kind)

    @override
    def of_union(self, kind: Any) -> Schema:
        if (component := ComponentConfig.within(kind)) is not None:
            return self._of_component(component)
        return super().of_union(kind)

    @override
    def of_mapping(self, kind: Any) -> Schema:
        several = super().of_mapping(kind)
        item = (*get_args(kind), Any, Any)[1]
        if (component := ComponentConfig.within(item)) is not None and component.may_be_alone:
            return {"if": {"required": ["type"]}, "then": several["additionalProperties"], "else": several}
        return several

    def _of_component(self, kind: type[ComponentConfig]) -> Schema:
        """The schema of a section with a `type`, which determines its further keys.

        Where a plugin defines the kind, the type may stand alone.
        """
        schema = self._of_typed(kind)
        if kind.plugin_kind not in self.registry.kinds:
            return schema
        return {"anyOf": [{"type": "string", "enum": schema["properties"][kind.type_key()]["enum"]}, schema]}

    def _of_typed(self, kind: type[ComponentConfig]) -> Schema:
        offered = [descriptor for descriptor in self.registry.of_kind(kind.plugin_kind) if descriptor.fits(kind)]
        own, key = self.of_fields(fields(kind)), kind.type_key()
        own["properties"][key]["enum"] = [descriptor.type for descriptor in offered]
        default = own["properties"][key].get("default")
        branches = [
            {
                "if": {
                    "properties": {key: {"const": descriptor.type}},
                    "required": [key] if descriptor.type != default else [],
                },
                "then": {
                    **self.of_fields({**fields(descriptor.options), **fields(kind)}),
                    "description": descriptor.summary,
                },
            }
            for descriptor in offered
        ]
        del own["additionalProperties"]
        return {**own, "allOf": branches} if branches else own
