"""Episodes, datasets and cards by their paths."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import attrs
from ibrobot_provenance.datasets import element_names

from ibrobot_core.api import JOINT_STATES, DatasetError, EpisodeAddress, Image, JointState, RecorderError
from ibrobot_core.app import installed_plugins

if TYPE_CHECKING:
    from ibrobot_diagnose.card import Card
    from ibrobot_diagnose.window import Window

RIG = "rig.json"
"""Name of the reference of a rig in the folder of a dataset."""
_INFO = Path("meta") / "info.json"
_MOST_EPISODES, _HIGHEST_RATE = 1_000_000, 10_000.0
_MOST_JOINTS = 1000
_NO_ANGLE = 10.0
"""Positions beyond it are no radians."""


def find_episodes(paths: Sequence[Path]) -> list[Path]:
    """Episodes of all paths: recordings, folders of them, and LeRobot datasets.

    Raises:
        DatasetError: for a LeRobot dataset whose description cannot be read.
    """
    listed: list[Path] = []
    for path in paths:
        episode = EpisodeAddress.find(path)
        if (info := dataset_info(episode)) is not None:
            listed += [episode.with_name(f"{episode.name}:{number}") for number in range(info["total_episodes"])]
            continue
        below = sorted(episode.glob("episodes/episode_*")) or sorted(episode.glob("*/episodes/episode_*"))
        if not below and episode.name == "episodes":
            below = sorted(episode.glob("episode_*"))
        listed += below or [episode]
    return list(dict.fromkeys(listed))


def dataset_info(path: Path) -> dict[str, Any] | None:
    """The description of a LeRobot dataset; None for anything else.

    Raises:
        DatasetError: if it cannot be read.
    """
    file = path / _INFO
    if not file.is_file():
        return None
    try:
        info = json.loads(file.read_text(encoding="utf-8"))
        info["total_episodes"], info["fps"] = int(info["total_episodes"]), float(info["fps"])
        features = info["features"]
        if not isinstance(features, dict) or not all(isinstance(each, dict) for each in features.values()):
            raise ValueError("features must be an object of objects")
        if not 0 <= info["total_episodes"] <= _MOST_EPISODES:
            raise ValueError(f"total_episodes must be from 0 to {_MOST_EPISODES}")
        if not 0 < info["fps"] <= _HIGHEST_RATE:
            raise ValueError(f"fps must be above 0, and at most {_HIGHEST_RATE}")
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DatasetError(f"{file}: cannot be read: {error!r}") from None
    return dict(info)


def read_episode(path: Path) -> Window:
    """Read an episode by its address.

    Raises:
        RecorderError: if it cannot be read.
    """
    from ibrobot_diagnose.window import read_window

    dataset = path.with_name(path.name.rpartition(":")[0]) if ":" in path.name else path
    info = dataset_info(dataset) if dataset != path and not path.exists() else None
    given = None if info is None or _is_own(dataset) else _given(dataset, info)
    with closing(installed_plugins().open_episode(path, given)) as reader:
        window = read_window(reader, str(path))
    if not len(window.ticks_ns):
        raise RecorderError(f"{path}: has no messages")
    return window if given is None else _in_radians(window)


def _is_own(dataset: Path) -> bool:
    """Whether `ibrobot convert` has made a dataset, so that it describes itself."""
    try:
        return "conversion" in json.loads((dataset / "meta" / "ibrobot.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return False


def _given(dataset: Path, info: Mapping[str, Any]) -> dict[str, str]:
    """What a dataset of another program does not say: a contract of its own features, in whatever unit they are."""
    features = info["features"]
    state, joints = _joints(dataset, features)
    align = {"strategy": "hold", "stamp": "header", "tol_ms": None}
    observations: dict[str, Any] = {
        "observation.state": [{
            "topic": JOINT_STATES, "type": JointState.ros_type, "select": [f"position.{each}" for each in state],
            "encoding": None, "shape": [len(state)], "align": align,
        }]
    }  # fmt: skip
    for key, feature in features.items():
        if feature.get("dtype") in ("video", "image"):
            shape = _shape(dataset, key, feature)
            observations[key] = [{
                "topic": f"/{key}", "type": Image.ros_type, "select": [], "encoding": "rgb8", "shape": shape,
                "align": {"strategy": "asof", "stamp": "header", "tol_ms": 200.0},
            }]  # fmt: skip
    action = [{"topic": "/commands", "type": "std_msgs/msg/Float64MultiArray", "joints": joints}]
    contract = {"version": 1, "units": "SI", "rate_hz": info["fps"], "observations": observations, "action": action}
    stated = {"observation.state": [f"{each}.pos" for each in state], "action": [f"{each}.pos" for each in joints]}
    return {"contract": json.dumps(contract), "norm_mode": "radians", "names": json.dumps(stated)}


def _joints(dataset: Path, features: Mapping[str, Any]) -> tuple[Sequence[str], Sequence[str]]:
    """The joints of the features `observation.state` and `action`; numbered from 1 if neither names its elements.

    Raises:
        RecorderError: if one of the features is not there, or it is unknown which element belongs to which.
    """
    named, sizes = [], []
    for key in ("observation.state", "action"):
        try:
            (size,) = (int(each) for each in features[key]["shape"])
            if not 0 < size <= _MOST_JOINTS:
                raise ValueError(size)
        except (LookupError, TypeError, ValueError, OverflowError):
            raise RecorderError(
                f"{dataset}: has no vector {key}, so joints are unknown; its features: {', '.join(features)}"
            ) from None
        names = [each.removesuffix(".pos") for each in element_names(features[key].get("names"))]
        named.append(names if len(names) == len(set(names)) == size else [])
        sizes.append(size)
    state, action = named
    if state and action:
        return state, action
    if sizes[0] != sizes[1]:
        raise RecorderError(
            f"{dataset}: observation.state has {sizes[0]} elements and action {sizes[1]}, and not both are named, so "
            "it is unknown which belong together; write a name for each into `names` of both in meta/info.json"
        )
    joints = state or action or [f"joint_{number}" for number in range(1, sizes[0] + 1)]
    return joints, joints


def _shape(dataset: Path, key: str, feature: Mapping[str, Any]) -> list[int]:
    """Height, width and channels of a feature's pictures.

    Raises:
        RecorderError: if it has none.
    """
    try:
        shape, names = [int(each) for each in feature["shape"]], feature.get("names")
    except (LookupError, TypeError, ValueError, OverflowError):
        shape = []
    if len(shape) != 3:
        raise RecorderError(
            f"{dataset / _INFO}: features: {key}: shape: pictures have [height, width, channels], got "
            f"{feature.get('shape')!r}"
        )
    if (isinstance(names, list) and names[:1] == ["channels"]) or (shape[0] == 3 and shape[-1] != 3):
        shape = [*shape[1:], shape[0]]
    return shape


def _in_radians(window: Window) -> Window:
    """The window with joints in radians, as far as this can be guessed: what is too large for radians is degrees."""
    import numpy as np

    largest = max(float(np.nanmax(np.abs(track.values), initial=0.0)) for track in (window.state, window.command))
    if largest <= _NO_ANGLE:
        return window
    scaled = [attrs.evolve(track, values=track.values * np.pi / 180) for track in (window.state, window.command)]
    return attrs.evolve(window, state=scaled[0], command=scaled[1])


def windows_of(path: Path) -> Iterator[Window]:
    """The episodes of a dataset.

    Raises:
        RecorderError: if one cannot be read.
    """
    for episode in find_episodes([path]):
        yield read_episode(episode)


def card_of(path: Path) -> Card:
    """The card of data: stored in a file or folder, or made of the episodes in it.

    Raises:
        DatasetError: if there is neither a card nor an episode, or the card cannot be read.
        RecorderError: if an episode cannot be read.
    """
    from ibrobot_diagnose.card import Card, make_card, with_card

    if path.is_file():
        return Card.read(path)
    folders = (path, path / "pretrained_model", path / "checkpoints" / "last" / "pretrained_model", path / "meta")
    if (stored := with_card(folders)) is not None:
        return Card.read(stored)
    return make_card(windows_of(path))


def reference_of(path: Path) -> Card:
    """What a rig is compared with: a reference that was taken, that of a dataset or checkpoint, or the card of data.

    Raises:
        DatasetError: as `card_of`, if it is not there, or its card says nothing of a rig.
    """
    if not path.exists():
        raise DatasetError(f"{path}: there is no such reference, dataset or checkpoint")
    taken = path / RIG
    card = card_of(taken if taken.is_file() else path)
    if card.rig is None:
        raise DatasetError(
            f"{path}: its card is from before preflight, and says nothing of the rig; make it again (`ibrobot datasets "
            "card`), or take a reference (`ibrobot preflight ROBOT --take FILE`)"
        )
    return card
