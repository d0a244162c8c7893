"""Atomic replacement of files."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import pytest
from ibrobot_provenance.files import replace_file


@pytest.mark.parametrize("content", ["ä", "ä".encode(), lambda file: file.write("ä".encode())])
def test_file_has_the_new_content_and_nothing_remains_beside_it(tmp_path: Path, content) -> None:
    (tmp_path / "file").write_text("old")
    replace_file(tmp_path / "file", content)
    assert (tmp_path / "file").read_text(encoding="utf-8") == "ä"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_old_content_remains_if_writing_fails(tmp_path: Path) -> None:
    def fails(file: BinaryIO) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    (tmp_path / "file").write_text("old")
    with pytest.raises(OSError, match="No space left"):
        replace_file(tmp_path / "file", fails)
    assert (tmp_path / "file").read_text() == "old"
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_content_is_on_the_disk_before_it_gets_the_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, seen = tmp_path / "file", []
    monkeypatch.setattr("os.fsync", lambda descriptor: seen.append(path.exists()))
    replace_file(path, "new")
    assert seen == [False, True], "the file, then the folder's entry"
