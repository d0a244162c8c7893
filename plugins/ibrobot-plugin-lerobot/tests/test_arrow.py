"""Arrays equal pyarrow's own; pandas stays out."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_lerobot.arrow import table_of, to_array

_SCALARS = {
    pa.bool_(): st.booleans(),
    pa.uint8(): st.integers(0, 255),
    pa.int32(): st.integers(-(2**31), 2**31 - 1),
    pa.int64(): st.integers(-(2**63), 2**63 - 1),
    pa.float32(): st.floats(width=32, allow_nan=False),
    pa.float64(): st.floats(allow_nan=False),
    pa.string(): st.text(),
    pa.binary(): st.binary(),
}


@st.composite
def arrays(draw, depth=2):
    """A type, and a strategy of its values."""
    what = draw(st.sampled_from(["scalar", "list", "fixed", "struct"])) if depth else "scalar"
    if what == "scalar":
        return draw(st.sampled_from(list(_SCALARS.items())))
    kind, values = draw(arrays(depth - 1))
    if what == "list":
        return pa.list_(kind), st.lists(values, max_size=3)
    if what == "fixed":
        size = draw(st.integers(1, 3))
        return pa.list_(kind, size), st.lists(values, min_size=size, max_size=size)
    other, more = draw(arrays(depth - 1))
    return pa.struct([("a", kind), ("b", other)]), st.fixed_dictionaries({"a": values, "b": more})


@given(st.data())
def test_arrays_equal_pyarrows(data):
    kind, each = data.draw(arrays())
    values = data.draw(st.lists(each, max_size=5))
    array = to_array(values, kind)
    array.validate(full=True)
    assert array.equals(pa.array(values, kind))


@pytest.mark.parametrize("dtype", ["bool", "float32", "float64", "int32", "int64", "uint8", "uint16"])
@pytest.mark.parametrize("width", [1, 3])
def test_arrays_of_numpys(dtype, width):
    block = (np.arange(5 * width).reshape(5, width) % 3).astype(dtype)
    kind = pa.from_numpy_dtype(block.dtype)
    array = to_array(block, kind if width == 1 else pa.list_(kind, width))
    array.validate(full=True)
    assert array.to_pylist() == (block[:, 0] if width == 1 else block).tolist()


def test_a_table_has_the_types_of_its_first_row():
    rows = [
        {"n": 3, "tasks": ["a"], "stats": [[[0.5]], [[1.0]]], "ok": True},
        {"n": 4, "tasks": ["b", "ü"], "stats": [], "ok": False},
    ]
    assert table_of(rows).equals(pa.Table.from_pylist(rows))
    assert table_of(rows[1:], table_of(rows).schema).to_pylist() == rows[1:]


def test_no_pandas(tmp_path):
    """Importing it takes longer than converting a short episode."""
    (tmp_path / "pandas").mkdir()
    (tmp_path / "pandas/__init__.py").touch()
    program = f"""
import sys; sys.path.insert(0, {str(tmp_path)!r})
import pathlib, numpy as np
from ibrobot_core.api import Feature
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.writer import LeRobotDatasetWriter
root = pathlib.Path({str(tmp_path)!r})
writer = LeRobotDatasetWriter(LeRobotOptions(videos=False))
features = {{"state": Feature("float32", (3,)), "done": Feature("bool", (1,)), "eye": Feature("image", (16, 16, 3))}}
for part in ("a", "b"):
    writer.create(root / part, 30.0, features, {{}})
    for _ in range(3):
        values = {{"state": np.zeros(3, np.float32), "done": np.array([True]), "eye": np.zeros((16, 16, 3), np.uint8)}}
        writer.add_frame(values, "task")
    writer.save_episode()
    writer.finalize()
writer.merge(root / "c", [root / "a", root / "b"], {{}})
assert writer.summary(root / "c").episodes == 2
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", program], check=True)
