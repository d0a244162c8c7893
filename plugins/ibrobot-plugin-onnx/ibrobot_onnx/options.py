"""Options of the policy `onnx`."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.api import Options, documented, option

MANIFEST = "onnx_policy.json"
"""The file that describes the graphs of an exported policy."""
PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}
"""Option -> ONNX Runtime's name."""


@documented
@attrs.frozen
class OnnxPolicyOptions(Options):
    """Folder, execution provider and threads."""

    path: Path = option(help=f"folder of `ibrobot export`: {MANIFEST} and, for inference, its graphs")
    provider: str = option(
        "cpu", choices=tuple(PROVIDERS), help="where ONNX Runtime runs the graphs; all but cpu need another build of it"
    )
    threads: int | None = option(None, ge=1, help="CPU threads; by default one fewer than the cores, at least 1")
    n_action_steps: int | None = option(None, ge=1, help="number of actions of a chunk to use; by default all")
