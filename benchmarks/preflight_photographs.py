"""What preflight's comparison of pictures says of photographs of real scenes, warped and lit in known ways.

    python benchmarks/preflight_photographs.py FOLDER... [--unchanged 8] [--seed 1]

FOLDER has photographs, of which those in `TUNED` and `FRESH` count, and videos (.mp4) of a camera that stands still
while a robot works in front of it, of which all count. Measures and thresholds were chosen on `TUNED`, of Debian's
`opencv-doc`. They were judged on `FRESH` once: rooms (ScanNet), a desk (TUM) and sights among the samples of SuperGlue,
OpenPose's examples (COCO), and scikit-image's photographs. Give the two in separate runs.

Of each photograph, a part of 640 x 480 pixels is the reference. Now, the camera has turned by a known angle: what was
outside comes into the picture. Always, the light differs by up to a tenth, there is other noise and compression, and
up to three things that were cut out of other photographs lie elsewhere; nothing masks them. `--unchanged` looks at each
scene that often without a fault. Of a video, reference and now are any two pictures of it, so that what has moved is
real; without those in which its autofocus hunts, since such a camera is not as it was. Prints a table, and the figures.
Exits with 1 if more than 1 in 200 unchanged scenes is accused, or a camera that moved by 20 pixels or 3 degrees is
called unmoved.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import attrs
import cv2
import numpy as np
from apparatus import report
from ibrobot_diagnose.pictures import shrink
from ibrobot_diagnose.rig import STILL_WIDTH, Still
from made_rigs import compared, rig
from made_runs import JOINTS
from numpy.typing import NDArray

type Picture = NDArray[np.uint8]

WIDTH, HEIGHT = 640, 480
IN_FOCUS = 0.8
"""Details that a picture of a video must have at least, in relation to those of the middle one."""
ROOM = 130
"""Around the part that the camera sees [px]: a turn by 10 degrees shows that much more."""
FOCAL = 0.98 * WIDTH
TUNED = (
    "aero1", "aloeL", "baboon", "basketball1", "board", "box_in_scene", "building", "butterfly", "ela_original",
    "fruits", "graf1", "home", "left01", "left12", "leuvenA", "licenseplate_motion", "messi5", "plant", "right05",
    "rubberwhale1", "scenetext01", "scenetext02", "scenetext03", "scenetext04", "scenetext05", "scenetext06",
    "squirrel_cls", "stuff", "sudoku",
)  # fmt: skip
"""Photographs of `opencv-doc` that show a scene: one of each pair, and no drawings, masks or texts."""
FRESH = (
    "1341847980.722988", "COCO_val2014_000000000192", "COCO_val2014_000000000241", "COCO_val2014_000000000257",
    "COCO_val2014_000000000294", "COCO_val2014_000000000328", "COCO_val2014_000000000338", "COCO_val2014_000000000357",
    "COCO_val2014_000000000360", "COCO_val2014_000000000395", "COCO_val2014_000000000415", "COCO_val2014_000000000428",
    "COCO_val2014_000000000459", "COCO_val2014_000000000474", "COCO_val2014_000000000488", "COCO_val2014_000000000536",
    "COCO_val2014_000000000544", "COCO_val2014_000000000564", "COCO_val2014_000000000569", "COCO_val2014_000000000589",
    "COCO_val2014_000000000623", "astronaut", "camera", "chelsea", "coffee", "london_bridge_19481797_2295892421",
    "motorcycle_left", "piazza_san_marco_06795901_3725050516", "rocket", "scene0711_00_frame-001680",
    "scene0713_00_frame-001320", "scene0721_00_frame-000375", "scene0722_00_frame-000045", "scene0726_00_frame-000135",
    "scene0737_00_frame-000930", "scene0738_00_frame-000885", "scene0743_00_frame-000000", "scene0744_00_frame-000585",
    "scene0747_00_frame-000000", "scene0752_00_frame-000075", "scene0755_00_frame-000120", "scene0758_00_frame-000165",
    "scene0768_00_frame-001095", "scene0806_00_frame-000225", "st_pauls_cathedral_30776973_2635313996",
    "united_states_capitol_26757027_6717084061",
)  # fmt: skip
"""Photographs that were not looked at while the measures were made."""
PICTURE_CAUSES = (
    "camera_moved", "picture_dark", "picture_bright", "picture_blurred", "picture_covered", "white_balance", "bgr",
    "picture_flipped",
)  # fmt: skip
MOVED = {f"{pixels} px": math.atan(pixels / FOCAL) for pixels in (2, 5, 20, 40)} | {
    f"{degrees} degrees": math.radians(degrees) for degrees in (1, 3, 10)
}
"""Name -> by how much the camera turns [rad]."""


def wide(photograph: Picture) -> Picture:
    """The photograph, large enough for the room around what the camera sees, cut to one size."""
    height, width = HEIGHT + 2 * ROOM, WIDTH + 2 * ROOM
    scale = max(height / photograph.shape[0], width / photograph.shape[1])
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    large = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=way)
    top, left = (large.shape[0] - height) // 2, (large.shape[1] - width) // 2
    return np.asarray(large[max(0, top) :, max(0, left) :][:height, :width], np.uint8)


def seen(scene: Picture, rotation: NDArray[np.float64]) -> Picture:
    """What a camera sees that has turned, shape (480, 640, 3)."""
    lens = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    shift = np.array([[1.0, 0, ROOM], [0, 1, ROOM], [0, 0, 1]])
    back = shift @ lens @ rotation @ np.linalg.inv(lens)
    return np.asarray(
        cv2.warpPerspective(scene, back, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP), np.uint8
    )


def turned(angle: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """A turn of the camera up, down or sideways, in a direction by chance."""
    way = rng.uniform(0, 2 * math.pi)
    return np.asarray(cv2.Rodrigues(angle * np.array([math.cos(way), math.sin(way), 0.0]))[0], np.float64)


def with_things(picture: Picture, others: list[Picture], rng: np.random.Generator) -> Picture:
    """The picture with up to three round pieces of other photographs on it, each up to a tenth of it."""
    result = picture.copy()
    for _ in range(int(rng.integers(0, 4))):
        other = others[int(rng.integers(len(others)))][ROOM : ROOM + HEIGHT, ROOM : ROOM + WIDTH]
        axes = int(rng.uniform(20, 110)), int(rng.uniform(20, 90))
        middle = int(rng.uniform(0, WIDTH)), int(rng.uniform(0, HEIGHT))
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.ellipse(mask, middle, axes, float(rng.uniform(0, 180)), 0, 360, 255, -1)
        result[mask > 0] = other[mask > 0]
    return result


def as_taken(picture: Picture, rng: np.random.Generator, light: float = 1.0) -> Picture:
    """With the noise and the compression of a camera."""
    noisy = np.clip(picture * light + rng.normal(0, 2.0, picture.shape), 0, 255).astype(np.uint8)
    sent = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(75, 96))])[1]
    return np.asarray(cv2.imdecode(sent, cv2.IMREAD_COLOR), np.uint8)


def blurred(picture: Picture) -> Picture:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.0), np.uint8)


def covered(picture: Picture) -> Picture:
    hidden = picture.copy()
    hidden[:, : WIDTH * 55 // 100] = 25
    return hidden


def warm(picture: Picture) -> Picture:
    return np.asarray(np.clip(picture * np.array([0.8, 1.0, 1.2]), 0, 255), np.uint8)  # blue, green, red


def darker(picture: Picture) -> Picture:
    return np.asarray(picture * 0.55, np.uint8)


FAULTS: dict[str, tuple[Callable[[Picture], Picture], str]] = {
    "darker": (darker, "picture_dark"), "white balance": (warm, "white_balance"),
    "blurred": (blurred, "picture_blurred"), "covered": (covered, "picture_covered"),
}  # fmt: skip


@attrs.frozen(eq=False)
class Scene:
    """A photograph, or a video of a camera that stands still."""

    name: str
    pictures: list[Picture]
    """One photograph, or pictures of the video; with the room around."""

    def pair(self, rng: np.random.Generator) -> tuple[Picture, Picture]:
        """What is there at first, and later."""
        chosen = rng.choice(len(self.pictures), 2, replace=len(self.pictures) == 1)
        return self.pictures[chosen[0]], self.pictures[chosen[1]]


def scenes(folders: list[Path]) -> Iterator[Scene]:
    """The scenes, in the order of their names: of photographs, then of videos.

    Raises:
        SystemExit: if a video has too few pictures.
    """
    paths = sorted({path.stem: path for folder in folders for path in sorted(folder.rglob("*.[jp][pn]g"))}.items())
    for name, path in paths:
        if name in (*TUNED, *FRESH) and (photograph := cv2.imread(str(path))) is not None:
            yield Scene(name, [wide(np.asarray(photograph, np.uint8))])
    for path in sorted(each for folder in folders for each in folder.rglob("*.mp4")):
        capture, taken = cv2.VideoCapture(str(path)), []
        while (read := capture.read())[0]:
            taken.append(read[1])
        if len(taken) < 20:
            raise SystemExit(f"{path}: has {len(taken)} pictures, at least 20 are needed")
        some = [wide(np.asarray(taken[i], np.uint8)) for i in range(0, len(taken), len(taken) // 20)]
        details = np.array([cv2.Laplacian(each, cv2.CV_32F).std() for each in some])
        yield Scene(
            path.stem, [each for each, own in zip(some, details > IN_FOCUS * np.median(details), strict=True) if own]
        )


def verdicts(then: Picture, now: Picture) -> tuple[dict[str, str], float]:
    """Cause -> verdict, and by how much the camera has moved [px]; pictures as OpenCV has them."""
    stills = [Still(shrink(each[..., ::-1], STILL_WIDTH), np.zeros(len(JOINTS))) for each in (now, then)]
    diagnosis = compared(rig(stills[0]), rig(stills[1]))
    listed = {each.name: each.evidence for each in (*diagnosis.findings, *diagnosis.measured)}
    number = listed["camera_moved"].number if "camera_moved" in listed else math.nan
    return {name: each.verdict for name, each in listed.items() if name in PICTURE_CAUSES}, number


@attrs.define
class Table:
    """Counts of verdicts."""

    counts: dict[str, Counter[str]] = attrs.field(factory=lambda: defaultdict(Counter))
    errors: dict[str, list[float]] = attrs.field(factory=lambda: defaultdict(list))
    alarms: list[str] = attrs.field(factory=list)
    unchanged: int = 0

    def look(self, scene: Scene, others: list[Picture], unchanged: int, rng: np.random.Generator) -> None:
        """Look at a scene without a fault and with each."""
        still = np.eye(3)

        def taken(picture: Picture, rotation: NDArray[np.float64], light: float = 1.0) -> Picture:
            view = seen(picture, rotation)
            return as_taken(with_things(view, others, rng) if len(scene.pictures) == 1 else view, rng, light)

        for _ in range(unchanged):
            then, now = scene.pair(rng)
            told, _ = verdicts(taken(then, still), taken(now, still, float(rng.uniform(0.9, 1.1))))
            self.unchanged += 1
            self.counts["unchanged"][told.get("camera_moved", "not tested")] += 1
            wrong = [name for name, verdict in told.items() if verdict in ("warn", "fail")]
            self.alarms += [f"{scene.name}: {', '.join(wrong)}"] if wrong else []
        for kind, angle in MOVED.items():
            then, now = scene.pair(rng)
            told, number = verdicts(taken(then, still), taken(now, turned(angle, rng), float(rng.uniform(0.9, 1.1))))
            verdict = told.get("camera_moved", "not tested")
            self.counts[f"moved {kind}"][verdict] += 1
            if kind.endswith("px") and verdict in ("ok", "warn", "fail"):
                self.errors[kind].append(abs(number - float(kind.split()[0])))
        for kind, (change, cause) in FAULTS.items():
            then, now = scene.pair(rng)
            told, _ = verdicts(taken(then, still), change(taken(now, still)))
            self.counts[kind][told.get(cause, "not tested")] += 1
        other = others[int(rng.integers(len(others)))]
        told, _ = verdicts(taken(scene.pair(rng)[0], still), taken(other, still))
        self.counts["another camera"][told.get("camera_moved", "not tested")] += 1

    def text(self) -> Iterator[str]:
        """The table."""
        yield f"{'planted':20}{'fail':>6}{'warn':>6}{'ok':>6}{'cannot tell':>13}"
        for kind, each in self.counts.items():
            numbers = "".join(f"{each[verdict]:>6}" for verdict in ("fail", "warn", "ok"))
            yield f"{kind:20}{numbers}{each['cannot tell'] + each['not tested']:>13}"
        for kind, values in self.errors.items():
            yield f"{kind}: measured to {np.median(values):.2f} pixels, at most {max(values):.2f}"
        yield f"unchanged: {len(self.alarms)} of {self.unchanged} accused"
        yield from (f"  {alarm}" for alarm in self.alarms)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, help="folders with photographs and videos")
    parser.add_argument("--unchanged", type=int, default=8, help="looks at each scene without a fault")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    known = list(scenes(arguments.folders))
    if len(known) < 2:
        raise SystemExit(f"{', '.join(map(str, arguments.folders))}: none of {', '.join((*TUNED, *FRESH))}")
    table = Table()
    for number, scene in enumerate(known):
        others = [each.pictures[0] for each in known if each is not scene]
        table.look(scene, others, arguments.unchanged, np.random.default_rng((arguments.seed, number)))
        print(f"{scene.name}: {len(table.alarms)} of {table.unchanged} accused so far", file=sys.stderr, flush=True)
    for line in table.text():
        print(line)
    large = ("20 px", "40 px", "3 degrees", "10 degrees")
    missed = sum(table.counts[f"moved {kind}"]["ok"] for kind in large)
    moved = [table.counts[f"moved {kind}"] for kind in MOVED if kind != "2 px"]
    found = sum(table.counts[kind]["fail"] + table.counts[kind]["warn"] for kind in FAULTS)
    told = sum(each["fail"] + each["warn"] for each in moved) / max(1, sum(each.total() for each in moved))
    report(
        scenes=len(known), unchanged=table.unchanged, accused=len(table.alarms), missed=missed, moved_found=told,
        faults_found=found / (len(FAULTS) * len(known)),
    )  # fmt: skip
    return int(missed > 0 or len(table.alarms) * 200 > table.unchanged)


if __name__ == "__main__":
    sys.exit(main())
