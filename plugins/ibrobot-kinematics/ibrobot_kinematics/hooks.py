"""The hooks: features of the contract. Importing it imports no NumPy."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_core.api import Late, hookimpl
from ibrobot_core.app import FeatureDescriptor

_OF_TOOLS = "ibrobot_kinematics.tool_features"
_OF_DELTAS = "ibrobot_kinematics.delta_features"
_VECTORS = Late("ibrobot_kinematics.feature_vectors:FeatureVectors")


@hookimpl
def ibrobot_features() -> Iterable[FeatureDescriptor]:
    """Poses of the tool, and positions of joints relative to the measured ones."""
    yield FeatureDescriptor(
        name="tool",
        model=Late(f"{_OF_TOOLS}:tool_model"),
        make=Late(f"{_OF_TOOLS}:tool_feature"),
        vectors=_VECTORS,
        check_config=Late("ibrobot_kinematics.check_features:faults"),
    )
    yield FeatureDescriptor(
        name="delta",
        model=lambda robot, paths: {},
        make=Late(f"{_OF_DELTAS}:delta_feature"),
        vectors=_VECTORS,
    )
