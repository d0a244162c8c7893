"""LeRobot's own processors, for non-standard steps such as a tokeniser; needs LeRobot and torch."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor.pipeline import ProcessorStep
from numpy.typing import NDArray

from ibrobot_core.api import PolicyError
from ibrobot_lerobot.checkpoint import POSTPROCESSOR, PREPROCESSOR, Checkpoint
from ibrobot_lerobot.policy_types import import_others
from ibrobot_lerobot.quiet import cause
from ibrobot_lerobot.untrusted import check_step_name

_DEVICE = {"device_processor": {"device": "cpu"}}


class LeRobotSteps:
    """The saved processors, which LeRobot runs on the CPU.

    Raises:
        PolicyError: if LeRobot cannot create them, e.g. because a tokeniser's files are missing, or a step is invalid.
    """

    def __init__(self, checkpoint: Checkpoint) -> None:
        for file, each in checkpoint.processors.items():
            for step in each["steps"]:
                if "registry_name" not in step:
                    _check_class(checkpoint.path / file, step["class"])
        overrides = {
            file: _DEVICE if any(step.get("registry_name") == "device_processor" for step in each["steps"]) else {}
            for file, each in checkpoint.processors.items()
        }
        import_others(checkpoint.path, checkpoint.type)
        try:
            config = PreTrainedConfig.from_pretrained(checkpoint.path)
            config.pretrained_path = checkpoint.path  # the file may have another path
            self._pre, self._post = make_pre_post_processors(
                config,
                pretrained_path=str(checkpoint.path),
                preprocessor_overrides=overrides[PREPROCESSOR],
                postprocessor_overrides=overrides[POSTPROCESSOR],
            )
        except Exception as error:
            raise PolicyError(f"{checkpoint.path}: LeRobot cannot create its processors: {cause(error)}") from error

    def preprocess(self, batch: Mapping[str, NDArray[Any]], prompt: str, robot_type: str) -> dict[str, NDArray[Any]]:
        """Run a batch of one through the preprocessor.

        Raises:
            PolicyError: if a step returns a value that is not an array, and so cannot be sent to a model.
        """
        tensors: dict[str, Any] = {key: torch.from_numpy(np.array(value)) for key, value in batch.items()}
        outputs = self._pre({**tensors, "task": prompt, "robot_type": robot_type})
        result: dict[str, NDArray[Any]] = {}
        for key, value in outputs.items():
            if isinstance(value, torch.Tensor):
                tensor = value.float() if value.dtype == torch.bfloat16 else value
                result[key] = np.array(tensor.numpy(force=True))
            elif key.startswith("observation."):
                raise PolicyError(f"the preprocessor gives {key} as {type(value).__name__}, which is not a tensor")
        return result

    def postprocess(self, action: NDArray[Any]) -> NDArray[Any]:
        """Run actions, shape (1, N, A), through the postprocessor."""
        return np.array(self._post(torch.from_numpy(np.array(action))).numpy(force=True))


def _check_class(path: Path, name: str) -> None:
    """Refuse a class below `lerobot` that is not a processor step, before LeRobot calls it."""
    module, _, attribute = name.rpartition(".")
    try:
        step = vars(import_module(module)).get(attribute)
    except ImportError as error:
        raise PolicyError(f"{path}: step {name!r} cannot be imported: {error}") from None
    if not (isinstance(step, type) and issubclass(step, ProcessorStep) and step.__module__.startswith("lerobot.")):
        raise PolicyError(f"{path}: step {name!r} is not a processor step of LeRobot")
    check_step_name(path, str(vars(step).get("_registry_name", "")))
