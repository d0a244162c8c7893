"""How often `ibrobot explain` names faults that are added to recordings of a real arm.

    python benchmarks/explain_real.py DATASET [--data 12] [--held 4] [--faults NAME ...]

DATASET is any LeRobot dataset, or a folder of recordings. Its first `--data` readable episodes are the data of the
model; the next `--held` ones are explained as they are, and with each fault: pictures of the first camera that are
dark, bright, blurred, covered, frozen, of other colours, turned or moved, cameras that are exchanged (where there are
two), positions in degrees, a joint's zero shifted by 20 degrees, and two joints with each other's place. The first line
must name the fault, and nothing if there is none. Prints a table, what else was named first, how often the fault is the
first that the unchanged recording does not have, too, and one JSON object.

No recording of a real arm comes with the repository: give one of your own, or a published one.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, override
from unittest.mock import patch

import attrs
import numpy as np
from apparatus import report
from ibrobot_diagnose import window
from ibrobot_diagnose.card import Maker
from ibrobot_diagnose.cause import Reference
from ibrobot_diagnose.diagnosis import diagnose
from ibrobot_diagnose.references import find_episodes, read_episode
from ibrobot_diagnose.window import Window, read_window
from numpy.typing import NDArray
from PIL import Image as Picture
from PIL import ImageFilter

from ibrobot_core.api import EpisodeReader, EpisodeSummary, IbrobotError, Image, Recorded

type Pixels = NDArray[np.uint8]
type Floats = NDArray[np.float64]


def _same(pixels: Pixels, t_s: float) -> Pixels:
    return pixels


def _frozen() -> Callable[[Pixels, float], Pixels]:
    """Pictures that stop for 4 s, 2 s after the beginning."""
    last: list[Pixels] = []

    def change(pixels: Pixels, t_s: float) -> Pixels:
        if not last or not 2.0 <= t_s < 6.0:
            last[:] = [pixels]
        return last[0]

    return change


def _scaled(*factors: float) -> Callable[[Pixels, float], Pixels]:
    return lambda pixels, t_s: np.clip(pixels * np.array(factors, np.float32), 0, 255).astype(np.uint8)


def _covered(pixels: Pixels, t_s: float) -> Pixels:
    hidden = pixels.copy()
    hidden[:, : int(0.6 * pixels.shape[1])] = (60, 50, 45)
    return hidden


def _filtered(change: Callable[[Picture.Image], Picture.Image]) -> Callable[[Pixels, float], Pixels]:
    return lambda pixels, t_s: np.asarray(change(Picture.fromarray(pixels)))


def _pushed(picture: Picture.Image) -> Picture.Image:
    """Shifted by 40 of 640 pixels, and turned by 3 degrees; edges are repeated."""
    by = round(picture.width / 16)
    turned = picture.rotate(3.0, Picture.Resampling.BILINEAR, translate=(by, by // 2))
    seen = np.asarray(picture.convert("L").point(lambda each: 255).rotate(3.0, translate=(by, by // 2))) > 0
    return Picture.fromarray(np.where(seen[..., None], np.asarray(turned), np.asarray(picture)))


def _unchanged() -> Callable[[Pixels, float], Pixels]:
    return _same


@attrs.frozen
class Fault:
    """A fault that is added to a recording."""

    looks: Callable[[], Callable[[Pixels, float], Pixels]] = _unchanged
    """Makes the function that changes the pictures of the first camera."""
    reads: Callable[[Floats], Floats] = lambda positions: positions
    """Changes positions and commands [rad], shape (N, J)."""
    exchanged: bool = False
    """Whether the first two cameras have each other's place."""


def _zero(positions: Floats) -> Floats:
    shift: Floats = np.radians(20.0) * (np.arange(positions.shape[1]) == 0)
    return positions + shift


def _order(positions: Floats) -> Floats:
    return positions[:, [1, 0, *range(2, positions.shape[1])]]


FAULTS: Mapping[str, Fault] = {
    "": Fault(),
    "picture_dark": Fault(lambda: _scaled(0.35)),
    "picture_bright": Fault(lambda: _scaled(1.9)),
    "picture_blurred": Fault(lambda: _filtered(lambda picture: picture.filter(ImageFilter.GaussianBlur(8)))),
    "picture_covered": Fault(lambda: _covered),
    "picture_frozen": Fault(_frozen),
    "white_balance": Fault(lambda: _scaled(1.5, 1.0, 0.6)),
    "bgr": Fault(lambda: lambda pixels, t_s: pixels[..., ::-1]),
    "picture_flipped": Fault(lambda: lambda pixels, t_s: pixels[::-1, ::-1]),
    "camera_moved": Fault(lambda: _filtered(_pushed)),
    "cameras_exchanged": Fault(exchanged=True),
    "other_units": Fault(reads=np.degrees),
    "joint_zero": Fault(reads=_zero),
    "joint_order": Fault(reads=_order),
}
"""Cause -> the fault that it explains; no cause for none."""


class Changed(EpisodeReader):
    """A recording with a fault in its pictures."""

    def __init__(self, reader: EpisodeReader, fault: Fault) -> None:
        self._reader, self._fault = reader, fault
        self.sampled = reader.sampled  # type: ignore[misc]

    @override
    def summary(self) -> EpisodeSummary:
        return self._reader.summary()

    @override
    def digest(self) -> str:
        return self._reader.digest()

    @override
    def close(self) -> None:
        self._reader.close()

    @override
    def messages(self, topics: Collection[str] | None = None) -> Iterator[Recorded]:
        summary, change = self.summary(), self._fault.looks()
        cameras = sorted(topic for topic, each in summary.topics.items() if each.type == Image.ros_type)
        places = {each: each for each in summary.topics}
        if self._fault.exchanged:
            places |= {cameras[0]: cameras[1], cameras[1]: cameras[0]}
        for item in self._reader.messages(topics):
            message: Any = item.message
            if isinstance(message, Image) and item.topic == cameras[0]:
                pixels = message.data.reshape(message.height, message.width, 3)
                shown = np.ascontiguousarray(change(pixels, (item.received_ns - summary.start_ns) / 1e9))
                message = attrs.evolve(message, data=shown.ravel())
            yield attrs.evolve(item, topic=places[item.topic], message=message)


def seen(episode: Path, fault: Fault) -> Window:
    """A recording with the pictures of a fault.

    Raises:
        IbrobotError: if it cannot be read.
    """
    with patch.object(window, "read_window", lambda reader, name: read_window(Changed(reader, fault), name)):
        return read_episode(episode)


def with_fault(episode: Path, plain: Window, fault: Fault) -> Window:
    """A recording with a fault; it is read again only if its pictures change."""
    recording = plain if fault.looks is _unchanged and not fault.exchanged else seen(episode, fault)
    state, command = (
        attrs.evolve(each, values=fault.reads(each.values)) for each in (recording.state, recording.command)
    )
    return attrs.evolve(recording, state=state, command=command)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="recordings of a real arm")
    parser.add_argument("--data", type=int, default=12, help="episodes that are the data of the model")
    parser.add_argument("--held", type=int, default=4, help="episodes that are explained")
    parser.add_argument("--faults", nargs="*", choices=[each for each in FAULTS if each], help="some of them")
    arguments = parser.parse_args()
    maker, held, known = Maker(), dict[Path, Window](), 0
    for episode in find_episodes([arguments.dataset]):
        if len(held) == arguments.held:
            break
        try:
            recording = seen(episode, FAULTS[""])
        except IbrobotError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        if known < arguments.data:
            maker.add(recording)
            known += 1
        else:
            held[episode] = recording
    reference = Reference(maker.card())
    cameras = len(reference.card.cameras) if reference.card is not None else 0
    right, added, named = Counter[str](), Counter[str](), Counter[tuple[str, str]]()
    unchanged: dict[Path, set[str]] = {}
    faults = [
        name for name, fault in FAULTS.items()
        if (not arguments.faults or name in ("", *arguments.faults)) and (cameras > 1 or not fault.exchanged)
    ]  # fmt: skip
    for name in faults:
        for episode, plain in held.items():
            diagnosis = diagnose(with_fault(episode, plain, FAULTS[name]), reference)
            weak = bool(diagnosis.findings) and diagnosis.findings[0].cause.weak
            first = "" if weak else diagnosis.first
            right[name] += first == name
            names = [each.name for each in diagnosis.findings]
            has = unchanged.setdefault(episode, set(names))  # the first round is without a fault
            added[name] += next((each for each in names if each not in has), "") == name
            named[name, first] += first != name
            said = [(each.name, round(each.evidence.likelihood, 2)) for each in diagnosis.findings]
            print(name or "no fault", episode.name, said, file=sys.stderr, flush=True)
    for name in faults:
        others = ", ".join(f"{first or '-'} {count}" for (of, first), count in named.items() if of == name and count)
        print(f"{name or 'no fault':20}{f'{right[name]}/{len(held)}':>8}{f'{added[name]}/{len(held)}':>8}  {others}")
    planted = [name for name in faults if name]
    result = {
        "held": len(held), "cameras": cameras, "faults": len(planted), "runs": len(planted) * len(held),
        "named_first": sum(right[name] for name in planted), "unchanged_accused": len(held) - right[""],
        "first_of_added": sum(added[name] for name in planted),
    }  # fmt: skip
    print(json.dumps(result))
    report(**result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
