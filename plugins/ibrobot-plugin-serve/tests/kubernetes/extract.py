"""Extracts the schemas that the manifests need from the PyPI package `kubernetes-validate` into `schema.json`.

    uv run --with kubernetes-validate==1.37.0 python extract.py

The package has 17,000 files, too many to install for each run of the tests. Descriptions are left out. The schemas are
those of Kubernetes' own API, Apache-2.0, see `NOTICE`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

VERSION = "v1.34.0-local-strict"
KINDS = (
    "io.k8s.api.core.v1.PersistentVolumeClaim",
    "io.k8s.api.apps.v1.StatefulSet",
    "io.k8s.api.core.v1.Service",
    "io.k8s.api.policy.v1.PodDisruptionBudget",
)


def references(schema: Any) -> Iterator[str]:
    """Names of the definitions that a schema uses."""
    if isinstance(schema, dict):
        if isinstance(schema.get("$ref"), str):
            yield schema["$ref"].rpartition("/")[2]
        schema = list(schema.values())
    if isinstance(schema, list):
        for each in schema:
            yield from references(each)


def bare(schema: Any, *, names: bool = False) -> Any:
    """A schema without descriptions; with `names`, a mapping from names of properties to schemas."""
    if isinstance(schema, list):
        return [bare(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    left_out = () if names else ("description", "x-kubernetes-group-version-kind")
    return {
        key: bare(value, names=key == "properties" and not names)
        for key, value in schema.items()
        if key not in left_out
    }


def main() -> None:
    """Write `schema.json`."""
    source = files("kubernetes_validate") / "kubernetes-json-schema" / VERSION / "_definitions.json"
    known = json.loads(source.read_text(encoding="utf-8"))["$defs"]
    found: dict[str, Any] = {}
    waiting = list(KINDS)
    while waiting:
        name = waiting.pop()
        if name not in found:
            found[name] = bare(known[name])
            waiting += references(known[name])
    text = json.dumps({"$defs": dict(sorted(found.items()))}, separators=(",", ":"))
    (Path(__file__).parent / "schema.json").write_text(text.replace("},", "},\n") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
