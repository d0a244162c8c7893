"""The plugin's hook: policy `onnx`, an exported policy on ONNX Runtime."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ibrobot_core.api import PolicyDescriptor, hookimpl
from ibrobot_onnx.options import MANIFEST, OnnxPolicyOptions

if TYPE_CHECKING:
    from ibrobot_core.api import Context, Policy


def _policy(options: Any, ctx: Context) -> Policy:
    from ibrobot_onnx.policy import OnnxPolicy

    return OnnxPolicy(options, ctx)


def _is_exported(path: Path) -> bool:
    return (path / MANIFEST).is_file()


@hookimpl
def ibrobot_policies() -> Iterable[PolicyDescriptor]:
    """The policy that runs ONNX graphs."""
    yield PolicyDescriptor(
        type="onnx",
        options=OnnxPolicyOptions,
        make=_policy,
        reads=_is_exported,
        summary="a folder of `ibrobot export --to onnx`, on ONNX Runtime, without torch",
    )
