"""Rotations have one logarithm: copies of it were wrong at half a turn."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[2]
PLACE = "plugins/ibrobot-kinematics/ibrobot_kinematics/rotations.py"


def test_only_the_shared_library_takes_angles_from_rotation_matrices():
    sources = [*ROOT.glob("ibrobot_core/**/*.py"), *ROOT.glob("plugins/*/*ibrobot*/**/*.py")]
    found = [str(path.relative_to(ROOT)) for path in sources if "trace(" in path.read_text(encoding="utf-8")]
    assert found == [PLACE], "use ibrobot_kinematics.rotations.log"
