from __future__ import annotations

import importlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from ibrobot_provenance import code
from ibrobot_provenance.code import differing_code, installed_code

Install = Callable[..., Path]


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Installs made-up packages, or others of the same name."""
    monkeypatch.setattr(sys, "path", [str(tmp_path)])

    def add(
        name: str, version: str = "1.0", *, requires: tuple[str, ...] = (), direct: dict[str, Any] | None = None,
        record: str = "",
    ) -> Path:  # fmt: skip
        file = name.replace("-", "_")
        for old in tmp_path.glob(f"{file}-*.dist-info"):
            shutil.rmtree(old)
        folder = tmp_path / f"{file}-{version}.dist-info"
        folder.mkdir()
        lines = [f"Requires-Dist: {each}" for each in requires]
        extras = ["Provides-Extra: more"] if "extra" in "".join(requires) else []
        (folder / "METADATA").write_text("\n".join([f"Name: {name}", f"Version: {version}", *lines, *extras]) + "\n")
        (folder / "RECORD").write_text(record)
        (tmp_path / "pack.py").write_text("")  # the file that a record names
        if direct is not None:
            (folder / "direct_url.json").write_text(json.dumps(direct))
        forget()
        return folder

    def forget() -> None:
        code._package.cache_clear()
        importlib.invalidate_caches()

    forget()
    yield add
    forget()


def of(*providers: str) -> dict[str, str]:
    found = installed_code(providers)
    assert found.pop("Python")
    return found


def test_all_that_a_plugin_requires_counts(install: Install) -> None:
    install(
        "my-plugin", requires=("Some_Library>=1", "other; extra == 'more'", "missing", "absent; python_version < '3'")
    )
    install("some-library", "2.0", requires=("deep", "tool; extra == 'dev'"))
    for name in ("deep", "other", "absent", "tool", "unrelated"):
        install(name)
    assert of("my_plugin") == {"deep": "1.0", "my-plugin": "1.0", "other": "1.0", "some-library": "2.0"}


@pytest.mark.parametrize("name", code.OPTIONAL)
def test_library_that_computes_counts_without_a_requirement(install: Install, name: str) -> None:
    install("plugin")
    before = of("plugin")
    install(name, "1.0")
    with_it = of("plugin")
    install(name, "1.1")
    assert (before.get(name), with_it[name], of("plugin")[name]) == (None, "1.0", "1.1")


ARCHIVE: dict[str, Any] = {"archive_info": {}}
SOURCES = ("pack/__init__.py", "pack/part.py", "pack/deep/part.py", "pack/data.yaml", "src/pack/__init__.py")


@pytest.mark.parametrize("change", ["edit", "add", "remove", "touch", "swap"])
@pytest.mark.parametrize("source", SOURCES)
def test_source_of_an_editable_package_counts(install: Install, tmp_path: Path, source: str, change: str) -> None:
    project = tmp_path / "my project"
    for name in (*SOURCES, "pack/a.py"):
        (project / name).parent.mkdir(parents=True, exist_ok=True)
        (project / name).write_text("x = 1\n")
    install("plugin", direct={"url": project.as_uri(), "dir_info": {"editable": True}})
    before = of("plugin")
    file = project / source
    if change == "edit":
        file.write_text("x = 3 # another\n")
    elif change == "swap":  # the same size
        file.write_text("x = 2\n")
        os.utime(file, ns=(1, 1))
    elif change == "add":
        file.with_name("new.py").write_text("")
    elif change == "remove":
        file.unlink()
    else:
        os.utime(file, ns=(1, 1))
    assert (of("plugin") == before) == (change == "touch"), (before, of("plugin"))
    assert of("plugin")["plugin"].startswith("1.0 (source ")


def test_source_of_a_single_module_counts(install: Install, tmp_path: Path) -> None:
    install("plugin", direct={"url": tmp_path.as_uri(), "dir_info": {"editable": True}})
    found = []
    for text in ("x = 1", "x = 20"):
        (tmp_path / "single.py").write_text(text)
        found.append(of("plugin"))
    assert found[0] != found[1]


@pytest.mark.parametrize(
    "beside", ["tests/test_pack.py", "tests/__init__.py", "README.md", "noxfile.py", "pack/__pycache__/a.pyc", ".git/x"]
)
def test_what_is_beside_the_source_does_not_count(install: Install, tmp_path: Path, beside: str) -> None:
    project = tmp_path / "project"
    (project / "pack").mkdir(parents=True)
    (project / "pack/__init__.py").write_text("")
    install("plugin", direct={"url": project.as_uri(), "dir_info": {"editable": True}})
    before = of("plugin")
    (project / beside).parent.mkdir(parents=True, exist_ok=True)
    (project / beside).write_text("new")
    assert of("plugin") == before


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"direct": {"vcs_info": {"commit_id": "a" * 40}}}, {"direct": {"vcs_info": {"commit_id": "b" * 40}}}),
        (
            {"direct": {"archive_info": {}}, "record": "pack.py,sha256=x,1"},
            {"direct": {"archive_info": {}}, "record": "pack.py,sha256=y,1"},
        ),
        ({"version": "1.0"}, {"version": "1.0.post1"}),
    ],
    ids=["commit", "archive", "version"],
)
def test_another_build_of_a_package_counts(install: Install, first: dict[str, Any], second: dict[str, Any]) -> None:
    install("library", **first)
    install("plugin", requires=("library",))
    before = of("plugin")
    install("library", **second)
    assert of("plugin")["library"] != before["library"]


def test_the_environment_of_this_test_has_what_episodes_depend_on() -> None:
    found = installed_code(["ibrobot-testing"])
    assert {"Python", "attrs", "numpy", "ibrobot-core", "ibrobot-testing"} <= found.keys()


def test_differences_in_words() -> None:
    wanted, here = {"a": "1", "b": "1", "c": "1"}, {"a": "2", "b": "1", "d": "3"}
    assert differing_code(wanted, here) == ["a 2, not 1", "c missing, not 1", "d 3, not installed"]
    assert differing_code(here, here) == []
