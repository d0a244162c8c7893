"""Datasets on the Hugging Face Hub: `push` uploads one in a single commit, and `pull` downloads one.

Both go on after an interruption when they are called again: files that have arrived are not transferred again.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ibrobot_terminal.plural import counted

from ibrobot_core.api import DatasetError, MissingDependency, how_to_install
from ibrobot_lerobot.read_contents import dataset_contents

_KINDS = ("meta", "data", "videos", "images")
"""The folders of a dataset. Nothing else is uploaded, deleted or downloaded, besides the card."""
_CARD = "README.md"
_STAGING = ".staging"
"""Folder of a conversion that is not finished."""
_NEW_CARD = """\
---
task_categories: [robotics]
tags: [LeRobot]
configs:
  - config_name: default
    data_files: data/*/*.parquet
---
{episodes} episodes, {frames} frames at {fps:g} Hz, recorded with ibrobot. Robot: {robot}. Tasks: {tasks}.
"""
_AGAIN = "run the same command again: it goes on where it was interrupted"


def push(dataset: Path, repository: str, *, private: bool = False) -> str:
    """Upload a dataset; files of an older version that it lacks are deleted there. Returns the address.

    The tag of the format's version, by which LeRobot finds a dataset, moves to the new commit.

    Args:
        dataset: its folder.
        repository: `OWNER/NAME`; created if there is none.
        private: whether a new repository is private.

    Raises:
        DatasetError: if it is no complete dataset, nobody is logged in, or the Hub refuses or cannot be reached.
        MissingDependency: without huggingface_hub.
    """
    hub = _hub()
    contents = dataset_contents(dataset)
    if (dataset / _STAGING).exists():
        raise DatasetError(f"{dataset}: a conversion into it is not finished")
    if hub.get_token() is None:
        raise DatasetError(
            "the Hub must know who uploads: run `hf auth login`, or set HF_TOKEN to a token that may write"
        )
    files = {path.relative_to(dataset).as_posix(): path for path in _files(dataset)}
    api = hub.HfApi(library_name="ibrobot")
    with _errors_of(repository):
        address = str(api.create_repo(repository, repo_type="dataset", private=private or None, exist_ok=True))
        there = api.list_repo_files(repository, repo_type="dataset")
        operations = [hub.CommitOperationAdd(name, path) for name, path in files.items()]
        if _CARD not in there and _CARD not in files:
            tasks = "; ".join(filter(None, contents.tasks)) or "none given"
            card = _NEW_CARD.format(
                episodes=contents.episodes, frames=contents.frames, fps=contents.fps, tasks=tasks,
                robot=contents.robot_type or "unknown",
            )  # fmt: skip
            operations.append(hub.CommitOperationAdd(_CARD, card.encode()))
        old = [name for name in there if name.split("/")[0] in _KINDS and name not in files]
        operations += [hub.CommitOperationDelete(name) for name in old]
        done = api.create_commit(
            repository, operations, repo_type="dataset", commit_message=counted(contents.episodes, "episode")
        )
        version = json.loads((dataset / "meta" / "info.json").read_text(encoding="utf-8"))["codebase_version"]
        tags = [each.name for each in api.list_repo_refs(repository, repo_type="dataset").tags]
        if version in tags:
            api.delete_tag(repository, tag=version, repo_type="dataset")
        api.create_tag(repository, tag=version, revision=done.oid, repo_type="dataset")
    return address


def pull(repository: str, out: Path, *, revision: str | None = None) -> None:
    """Download a dataset.

    Args:
        repository: `OWNER/NAME`.
        out: its folder: a new or empty one, or that of an earlier download of it.
        revision: a branch, tag or commit; None for the newest.

    Raises:
        DatasetError: if the folder has other files, the repository has no LeRobot v3 dataset, or the Hub refuses or
            cannot be reached.
        MissingDependency: without huggingface_hub.
    """
    hub = _hub()
    if out.exists() and any(out.iterdir()) and not (out / ".cache" / "huggingface").is_dir():
        raise DatasetError(f"{out}: is not empty, and not from an earlier `ibrobot datasets pull`")
    patterns = [_CARD, *(f"{kind}/*" for kind in _KINDS)]
    with _errors_of(repository):
        hub.snapshot_download(
            repository, repo_type="dataset", revision=revision, local_dir=out, allow_patterns=patterns,
            library_name="ibrobot",
        )  # fmt: skip


def _files(dataset: Path) -> Iterator[Path]:
    """The files of a dataset, and its card if it has one."""
    card = dataset / _CARD
    yield from [card] if card.is_file() else []
    for kind in _KINDS:
        yield from sorted(path for path in (dataset / kind).rglob("*") if path.is_file())


@contextmanager
def _errors_of(repository: str) -> Iterator[None]:
    """Errors of huggingface_hub on one line, with what to do."""
    import httpx
    from huggingface_hub import errors

    try:
        yield
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError) as error:
        what = "revision" if isinstance(error, errors.RevisionNotFoundError) else "dataset"
        raise DatasetError(f"{repository}: the Hub has no such {what}, or your token may not read it") from error
    except errors.HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else 0
        if status in (401, 403):
            raise DatasetError(f"{repository}: the Hub refuses the token: `hf auth login` takes another one") from error
        raise DatasetError(f"{repository}: the Hub answered {status}; {_AGAIN}") from error
    except (errors.LocalEntryNotFoundError, httpx.HTTPError, ConnectionError) as error:
        raise DatasetError(f"{repository}: the Hub cannot be reached; {_AGAIN}") from error
    except (errors.HFValidationError, ValueError) as error:
        raise DatasetError(f"{repository}: {error}") from error


def _hub() -> Any:
    try:
        import httpx  # noqa: F401  # of the versions of huggingface_hub that are meant
        import huggingface_hub
    except ImportError:
        raise MissingDependency(
            "the Hub needs huggingface_hub 1", remedy=how_to_install("ibrobot-plugin-lerobot[hub]")
        ) from None
    return huggingface_hub
