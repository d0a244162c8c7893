"""Whether the causes are named on recordings of a real arm: faults laid over episodes of any LeRobot dataset.

    python benchmarks/explain_recordings.py DATASET [--episodes 6] [--work explain_recordings]

The card is made of all episodes but the last `--episodes`. Over each of these, faults are laid in three strengths:
pictures dimmed, covered, blurred, in BGR, turned over or shifted; the zero of a joint shifted; positions in another
unit; two joints exchanged; cameras exchanged where there are two. The first line must name the fault; an episode as it
is must be accused of nothing. No dataset comes with this repository: `ibrobot datasets pull` fetches one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import attrs
import numpy as np
from figures import report
from ibrobot_diagnose import window as windows
from ibrobot_diagnose.card import Card, make_card
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.causes import others
from ibrobot_diagnose.diagnosis import diagnose, installed_causes
from ibrobot_diagnose.references import find_episodes, read_episode
from ibrobot_diagnose.window import Camera, Window
from numpy.typing import NDArray
from PIL import Image, ImageFilter

from ibrobot_core.api import Image as ImageMessage

EVERY = 3
"""Of so many pictures one is looked at."""
STRENGTHS = ("mild", "medium", "strong")
type Pixels = NDArray[np.uint8]


def dimmed(picture: Pixels, factor: float) -> Pixels:
    """Less light."""
    return (picture * factor).astype(np.uint8)


def covered(picture: Pixels, share: float) -> Pixels:
    """Something before the lens."""
    hidden = picture.copy()
    hidden[:, : round(share * picture.shape[1])] = (60, 50, 45)
    return hidden


def blurred(picture: Pixels, width: float) -> Pixels:
    """Out of focus; the width is a share of the picture's."""
    soft = Image.fromarray(picture).filter(ImageFilter.GaussianBlur(width * picture.shape[1]))
    return np.asarray(soft)


def shifted(picture: Pixels, share: float) -> Pixels:
    """A camera that was turned aside: what comes in repeats the edge."""
    by = round(share * picture.shape[1])
    return np.concatenate([np.repeat(picture[:, :1], by, axis=1), picture[:, : picture.shape[1] - by]], axis=1)


SEEN: dict[str, tuple[Callable[..., Pixels], tuple[Any, ...]]] = {
    "picture_dark": (dimmed, (0.65, 0.5, 0.25)),
    "picture_covered": (covered, (0.4, 0.6, 1.0)),
    "picture_blurred": (blurred, (0.005, 0.01, 0.02)),
    "bgr": (lambda picture, _: np.ascontiguousarray(picture[..., ::-1]), (1, 1, 1)),
    "picture_flipped": (lambda picture, _: np.ascontiguousarray(picture[::-1, ::-1]), (1, 1, 1)),
    "camera_moved": (shifted, (0.02, 0.05, 0.12)),
}
"""Cause -> what becomes of the pictures of the first camera, and its three strengths."""


def with_positions(window: Window, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Window:
    """An episode whose arm reports, and is commanded, other positions; shape (N, J)."""
    state, command = (attrs.evolve(each, values=change(each.values.copy())) for each in (window.state, window.command))
    return attrs.evolve(window, state=state, command=command)


def zero(values: NDArray[Any], joint: int, by: float) -> NDArray[Any]:
    """The zero of a joint, shifted."""
    values[:, joint] += by
    return values


def positions(window: Window) -> Iterator[tuple[str, str, Window]]:
    """Cause, strength and episode, of the faults in the joints."""
    ranges = np.nan_to_num(np.ptp(window.states, axis=0))
    moving = int(np.argmax(ranges))
    second = int(np.argsort(ranges)[-2])
    for strength, by in zip(STRENGTHS, (0.2, 0.3, 0.45), strict=True):
        yield "joint_zero", strength, with_positions(window, lambda values, by=by: zero(values, moving, by))
        yield "other_units", strength, with_positions(window, lambda values: values * 180 / np.pi)
        order = list(range(len(window.joints)))
        order[moving], order[second] = order[second], order[moving]
        yield "joint_order", strength, with_positions(window, lambda values, order=order: values[:, order])


def cameras(window: Window) -> Iterator[tuple[str, str, Window]]:
    """As `positions`, of cameras that have each other's place."""
    keys = list(window.cameras)
    if len(keys) > 1:
        both = {keys[0]: window.cameras[keys[1]], keys[1]: window.cameras[keys[0]]}
        exchanged = attrs.evolve(window, cameras={**window.cameras, **both})
        yield from (("cameras_exchanged", strength, exchanged) for strength in STRENGTHS)


def read(episode: Path) -> tuple[Window, list[tuple[str, int, Any]]]:
    """An episode with every `EVERY`th picture, and these: topic, time [ns] and message."""
    take, counts = windows._Reading._take_picture, Counter[str]()
    kept: list[tuple[str, int, Any]] = []

    def some(self: Any, camera: Camera, message: Any, t_ns: int) -> None:
        if counts[camera.topic] % EVERY == 0:
            kept.append((camera.topic, t_ns, message))
            take(self, camera, message, t_ns)
        counts[camera.topic] += 1

    with patch.object(windows._Reading, "_take_picture", some):
        return read_episode(episode), kept


def pictures(window: Window, kept: Sequence[tuple[str, int, Any]]) -> Iterator[tuple[str, str, Window]]:
    """As `positions`, of what the first camera sees."""
    if not window.cameras:
        return
    key, seen = next(iter(window.cameras.items()))
    every = SimpleNamespace(_keep_every_ns=int(1e9 * window.seconds / windows.KEPT), _still_every_ns=int(1e9))
    for name, (change, arguments) in SEEN.items():
        for strength, argument in zip(STRENGTHS, arguments, strict=True):
            camera = Camera(key, seen.topic)
            for topic, t_ns, message in kept:
                if topic == seen.topic:
                    shown = np.asarray(change(windows._rgb(message), argument), np.uint8)
                    changed = ImageMessage(message.header, *shown.shape[:2], "rgb8", 3 * shown.shape[1], shown.ravel())
                    windows._Reading._take_picture(every, camera, changed, t_ns)  # type: ignore[arg-type]
            yield name, strength, attrs.evolve(window, cameras={**window.cameras, key: camera})


def trials(episode: Path) -> Iterator[tuple[str, str, Window]]:
    """Cause, strength and episode with that fault; the episode as it is first."""
    window, kept = read(episode)
    yield "", "", window
    yield from positions(window)
    yield from cameras(window)
    yield from pictures(window, kept)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="a LeRobot dataset, or a folder of recorded episodes")
    parser.add_argument("--episodes", type=int, default=6, help="episodes over which faults are laid")
    parser.add_argument("--of", type=int, help="episodes of the dataset that are used; by default all")
    parser.add_argument("--work", type=Path, default=Path("explain_recordings"), help="folder of the card")
    arguments = parser.parse_args()
    episodes = find_episodes([arguments.dataset])[: arguments.of]
    kept, held = episodes[: -arguments.episodes], episodes[-arguments.episodes :]
    file = arguments.work / "reference.json"
    if not file.exists():
        arguments.work.mkdir(parents=True, exist_ok=True)
        make_card(read(each)[0] for each in kept).write(file)
    reference = Reference(Card.read(file))
    causes = [each for each in installed_causes() if type(each) not in others.TOOLS and each.name != "not_judged"]
    right, all_of, accused = Counter[tuple[str, str]](), Counter[tuple[str, str]](), Counter[str]()
    for episode in held:
        for name, strength, window in trials(episode):
            diagnosis = diagnose(window, reference, causes)
            if not name:
                accused[diagnosis.first] += 1
            all_of[name, strength] += 1
            right[name, strength] += diagnosis.first == name
            if diagnosis.first != name:
                listed = [(each.name, round(each.evidence.likelihood, 2)) for each in diagnosis.findings]
                print(episode.name, name or "as it is", strength, listed, file=sys.stderr, flush=True)
    names = [each for each in dict.fromkeys(name for name, _ in all_of) if each]
    print(f"{'cause':20}{''.join(f'{strength:>10}' for strength in STRENGTHS)}")
    for name in names:
        cells = [f"{right[name, each]}/{all_of[name, each]}" for each in STRENGTHS]
        print(f"{name:20}{''.join(f'{cell:>10}' for cell in cells)}")
    shares = {each: sum(right[name, each] for name in names) / (len(names) * len(held)) for each in STRENGTHS}
    print(json.dumps({"right": shares, "episodes": len(held), "accused": {k: v for k, v in accused.items() if k}}))
    report(**shares, healthy=len(held), accused=len(held) - accused[""])
    return 0


if __name__ == "__main__":
    sys.exit(main())
