"""The plugin's hook: policy `onnx`, an exported policy on ONNX Runtime."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ibrobot_core.api import Late, PolicyDescriptor, hookimpl
from ibrobot_onnx.options import MANIFEST, OnnxPolicyOptions


def _is_exported(path: Path) -> bool:
    return (path / MANIFEST).is_file()


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """The policy that runs ONNX graphs."""
    yield PolicyDescriptor(
        type="onnx",
        options=OnnxPolicyOptions,
        make=Late("ibrobot_onnx.policy:OnnxPolicy"),
        reads=_is_exported,
        summary="a folder of `ibrobot export --to onnx`, on ONNX Runtime, without torch",
    )
