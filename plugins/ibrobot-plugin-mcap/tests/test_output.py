"""The file of an episode: beside the page cache or through it, what was handed over is there."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ibrobot_mcap import output


@pytest.fixture(scope="module", params=["direct", "refused at once", "refused when written"])
def way(request: pytest.FixtureRequest):
    """Three kinds of file system."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "refused at once":
            patch.setattr(output, "_open_direct", lambda path: None)
        if request.param == "refused when written":  # where 100 bytes are no block
            patch.setattr(output, "_BLOCK", 100)
        yield request.param


sizes = st.one_of(st.integers(0, 300), st.sampled_from([4095, 4096, 4097, 1 << 20, (1 << 20) + 5]))


@settings(deadline=None, max_examples=15)
@given(st.lists(st.one_of(sizes, st.none()), max_size=8), st.integers())
def test_what_was_handed_over_is_in_the_file(way, steps, seed):
    chance = random.Random(seed)  # Hypothesis' own takes seconds for a megabyte
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        file, written = output.Output(path), b""
        for size in steps:
            if size is None:
                file.hand_over()
                assert path.read_bytes() == written
            else:
                data = chance.randbytes(size)
                assert file.write(data) == size
                written += data
            assert file.size == file.tell() == len(written)
            assert written.startswith(path.read_bytes())
        file.hand_over()
        file.close()
        assert path.read_bytes() == written


@settings(deadline=None, max_examples=15)
@given(sizes, sizes, sizes)
def test_a_file_that_was_cut_goes_on_from_there(way, kept, lost, added):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        file = output.Output(path)
        file.write(bytes(kept))
        file.hand_over()
        file.write(b"x" * lost)
        file.cut(kept)
        file.write(b"y" * added)
        file.hand_over()
        file.close()
        assert path.read_bytes() == bytes(kept) + b"y" * added
