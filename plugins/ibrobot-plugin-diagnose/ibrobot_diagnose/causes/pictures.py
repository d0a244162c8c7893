"""Causes in the pictures, compared with the pictures of the model's data."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, override

import attrs
import numpy as np
from numpy.typing import NDArray

from ibrobot_diagnose.alignment import Shift, shift_of
from ibrobot_diagnose.card import (
    CameraCard,
    Card,
    background_of,
    in_grey,
    numbers_of,
    repeated_of,
    still,
)
from ibrobot_diagnose.cause import ACCUSED, CardCause, Cause, Evidence, Reference, likelihood
from ibrobot_diagnose.causes.moved import FAILS, WARNS, Sight, sights
from ibrobot_diagnose.looks import Looks
from ibrobot_diagnose.pictures import Shown, descriptors, nearest, resized
from ibrobot_diagnose.rig import Rig
from ibrobot_diagnose.window import COMPARED, Camera, Window

_IN_HAND = 20.0
"""Share of the picture of a camera on the arm that may be empty if the arm holds nothing [%]."""
_ALIKE = 0.15
"""Difference of all joints below which the arm stands alike [rad]."""
UNSEEN = frozenset({"unseen_pictures", "camera_ignored"})


@attrs.frozen(eq=False)
class Pair:
    """A camera of the window, and that of the model's data."""

    camera: Camera
    card: CameraCard
    window: Window

    def at_like_poses(self) -> tuple[NDArray[np.uint8], NDArray[np.uint8]] | None:
        """Pictures of the run and of the data at which the arm stands alike, shape (N, 24, 32, 3) each.

        None for fewer than five.
        """
        count = len(self.camera.pictures)
        index = np.unique(np.linspace(0, count - 1, min(COMPARED, count)).round().astype(int))
        poses = self.window.state.at(np.array(self.camera.times_ns, np.int64)[index])
        if poses.shape[1] != self.card.poses.shape[1]:
            return None
        apart = np.nan_to_num(np.abs(poses[:, None] - self.card.poses[None]), nan=np.inf).max(axis=2)
        near, alike = apart.argmin(axis=1), apart.min(axis=1) < _ALIKE
        if alike.sum() < 5:
            return None
        own = np.stack([self.camera.pictures[i].small for i in index[alike].tolist()])
        return own, self.card.thumbnails[near[alike]]

    def fit_to(self, other: Pair, changed: Callable[[Any], Any] = lambda small: small) -> tuple[float, float]:
        """How much better this camera's pictures, if they are changed, fit another pair's data than its own.

        Returns: the share of the pictures that are nearer to a picture there, and how many times as near they are.
        """
        own, vectors = (descriptors(each) for each in (self.camera.sample, changed(self.camera.sample)))
        here, there = nearest(own, self.card.vectors)[0], nearest(vectors, other.card.vectors)[0]
        return float((there < here).mean()), float(np.median(here)) / max(float(np.median(there)), 1e-3)

    def distance(self, changed: Callable[[Any], Any] = lambda small: small) -> float:
        """Median distance to the nearest thumbnail of the data, of pictures that are changed first."""
        return float(np.median(nearest(descriptors(changed(self.camera.sample)), self.card.vectors)[0]))

    def beside(self) -> tuple[Shown, ...]:
        """A picture of the run, and the nearest one of the data."""
        index = len(self.camera.pictures) // 2
        kept = min(self.camera.kept, key=lambda i: abs(i - index))
        _, near = nearest(descriptors(self.camera.small[kept : kept + 1]), self.card.vectors)
        episode, at_s = self.card.places[int(near[0])]
        name = self.camera.name
        return (
            Shown(f"{name} in this run", self.camera.kept[kept]),
            Shown(f"{name} in the data: {episode}, {at_s:.1f} s", self.card.thumbnails[int(near[0])]),
        )


def pairs(window: Window, card: Card) -> Iterator[Pair]:
    """The cameras that both have."""
    for key, known in card.cameras.items():
        camera = window.cameras.get(key)
        if camera is not None and camera.pictures:
            yield Pair(camera, known, window)


class PictureCause(CardCause):
    """A cause that looks at each camera alone; the worst one counts."""

    needs = frozenset({"pictures", "card pictures"})
    explains = UNSEEN
    unit: ClassVar[str] = "times"
    threshold: ClassVar[float]
    certain: ClassVar[float]
    of_stills: ClassVar[tuple[float, float] | None] = None
    """The two for the stills of a rig; None if they are the same."""

    def measure(self, pair: Pair) -> tuple[float, str] | None:
        """How strong it is, by `threshold` and `certain`, and a sentence; None if it is uncertain."""
        raise NotImplementedError

    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        """The same from the stills of a rig, of a camera with a name; None if they say nothing of it."""
        return None

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if window.rig is not None and card.rig is not None:
            return self._of_rigs(window.rig, card.rig)
        measured = [(result, pair) for pair in pairs(window, card) if (result := self.measure(pair)) is not None]
        if not measured:
            return None
        (number, text), pair = max(measured, key=lambda each: each[0][0])
        likely = likelihood(number, self.threshold, self.certain)
        return Evidence(text, number, self.unit, self.threshold, likely, pictures=pair.beside() if likely > 0.4 else ())

    def _of_rigs(self, now: Rig, then: Rig) -> Evidence | None:
        seen = sights(now, then)
        measured = [
            (*result, each) for each in seen
            if each.looks is not None and (result := self.see(each.name, each.looks)) is not None
        ]  # fmt: skip
        if not measured:
            return None
        threshold, certain = self.of_stills or (self.threshold, self.certain)
        (number, text, sight), *others = sorted(measured, key=lambda each: -each[0])
        likely = likelihood(number, threshold, certain)
        also = [each for each in others if likelihood(each[0], threshold, certain) >= ACCUSED]
        shown = [sight, *(each[2] for each in also)] if likely > 0.4 else []
        return Evidence(
            text, number, self.unit, threshold, likely, details=tuple(each[1] for each in also),
            pictures=tuple(picture for each in shown for picture in now_and_then(each)), fails=certain,
        )  # fmt: skip


def now_and_then(sight: Sight) -> tuple[Shown, ...]:
    """The pictures of a camera, now and in the reference."""
    return Shown(f"{sight.name} now", sight.now), Shown(f"{sight.name} in the reference", sight.then)


class CamerasExchanged(CardCause):
    """Two cameras have each other's place."""

    name = "cameras_exchanged"
    title = "each camera has its own place"
    needs = frozenset({"pictures", "card pictures"})
    explains = frozenset({
        "camera_moved", "picture_dark", "picture_bright", "picture_blurred", "picture_covered", "white_balance", "bgr",
        "picture_flipped", "joint_zero", "gripper_reversed", *UNSEEN,
    })  # fmt: skip
    remedy = (
        "Exchange the devices of these cameras in the robot YAML (`peripherals: …`); `ibrobot camera preview` shows "
        "which is which. A path below /dev/v4l/by-path stays with the USB port."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        best: tuple[float, float, float, Pair, Pair] | None = None
        for one, other in itertools.combinations(pairs(window, card), 2):
            fits = one.fit_to(other), other.fit_to(one)
            share, ratio = (min(each) for each in zip(*fits, strict=True))
            # Each picture of both shows it; a few pictures that look like the other's do not.
            likely = min(likelihood(share, 0.7, 0.9), likelihood(ratio, 1.1, 1.25))
            if best is None or likely > best[0]:
                best = likely, share, ratio, one, other
        if best is None:
            return None
        likely, share, ratio, one, other = best
        text = (
            f"The cameras {one.camera.name} and {other.camera.name} are exchanged: at least {100 * share:.0f} % of the "
            f"pictures of each look more like the other's in the data, and are {ratio:.1f} times as close to these."
        )
        shown = one.beside() + other.beside()
        if window.rig is not None and card.rig is not None:
            names = one.camera.name, other.camera.name
            stills = (now_and_then(each) for each in sights(window.rig, card.rig) if each.name in names)
            shown = tuple(itertools.chain.from_iterable(stills)) or shown
        return Evidence(text, 100 * share, "%", 70.0, likely, pictures=shown)


class CameraMoved(PictureCause):
    """A camera does not stand where it stood."""

    name = "camera_moved"
    title = "the cameras stand as in the data"
    explains = UNSEEN | {"joint_zero", "gripper_reversed"}
    unit, threshold, certain = "pixels", 1.0, 2.0
    remedy = (
        "Put the camera back: “Put a camera back” under “Devices” of `ibrobot ui` draws the reference over the live "
        "picture, and says how far the camera still is from its place; the report (`--out`) has both pictures. If the "
        "camera must stay there, record some episodes from its new place and train again."
    )
    for_episodes = (
        "Drop it if the camera has been put back since. If it stays where it stands now, keep it, and record more from "
        "there."
    )

    @override
    def compare(self, window: Window, card: Card) -> Evidence | None:
        if window.rig is None or card.rig is None:
            return super().compare(window, card)
        seen = sights(window.rig, card.rig)
        clear = [each for each in seen if not each.unclear]
        if not seen:
            return None
        worst = max(clear, key=lambda each: each.pixels) if clear else seen[0]
        moved = bool(clear) and worst.pixels >= WARNS
        if not moved and len(clear) < len(seen):
            worst = next(each for each in seen if each.unclear)
        number = 0.0 if worst.unclear else worst.pixels
        return Evidence(
            worst.text, number, "pixels", WARNS, likelihood(number, WARNS, 3 * WARNS), fails=FAILS,
            details=tuple(each.text for each in seen if each is not worst), unclear=worst.unclear,
            pictures=now_and_then(worst) if moved else (),
        )  # fmt: skip

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        if pair.card.rides:
            return None  # it moves with the arm; preflight compares it at the same pose
        shift = shift_between(pair)
        name = pair.camera.name
        if shift is None:
            return None
        usual = max(4.0, 3.0 * pair.card.usual_shift)
        if shift.after > 0.45 and shift.after > shift.before + 0.02:
            turned = f", turned by {np.degrees(abs(shift.angle)):.1f}°" if abs(shift.angle) > 0.01 else ""
            text = (
                f"The camera {name} has moved: its picture is shifted by {shift.pixels:.0f} of 640 pixels{turned}; up "
                f"to {usual:.0f} are usual."
            )
            return shift.pixels / usual, text
        if shift.after < 0.3 and shift.before < 0.3:
            distance = pair.distance()
            text = (
                f"The camera {name} shows another view than in the data: what stands still agrees to "
                f"{shift.before:.2f} "
                "only (1 is equal), wherever one looks for it."
            )
            return min(1.6, 0.8 * distance / pair.card.usual_distance), text
        return 0.0, f"The camera {name} stands as in the data."


def shift_between(pair: Pair) -> Shift | None:
    """How far a camera's background has moved from that of the data; None if it is uncertain."""
    own = background_of(pair.camera)
    if own is None:
        return None
    reference, weight = in_grey(pair.card.background), still(in_grey(pair.card.moving))
    middle, moving = own
    if middle.shape != reference.shape:
        size = reference.shape[0], reference.shape[1]
        middle, moving = resized(middle, size), resized(moving, size)
    return shift_of(reference, middle, weight * still(moving))


class _Level(PictureCause):
    """A number of the pictures lies outside that of the data."""

    number: ClassVar[str]
    above: ClassVar[bool] = False
    words: ClassVar[str]

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        value = float(np.median(numbers_of(pair.camera)[self.number]))
        low, high = (pair.card.at(self.number, level) for level in (0.05, 0.95))
        usual = high if self.above else low
        ratio = (value + 1e-3) / (usual + 1e-3) if self.above else (usual + 1e-3) / (value + 1e-3)
        if self.number == "brightness" and self.above:  # a bright scene cannot become much brighter: it turns white
            white = float(np.median(numbers_of(pair.camera)["clipped"])) - pair.card.at("clipped", 0.95)
            ratio = max(ratio, 1.0 + white)
        return ratio, f"The pictures of {pair.camera.name} are too {self.words}: {self.compared(value, low, high)}."

    def compared(self, value: float, low: float, high: float) -> str:
        """The number, and its range in the data, in words."""
        return f"their {self.number} is {value:.0f} of 255; in the data it is {low:.0f} to {high:.0f}"


class PictureDark(_Level):
    """Pictures are darker."""

    name, title, number, words = "picture_dark", "pictures are as bright as in the data", "brightness", "dark"
    threshold, certain = 1.3, 1.9
    explains = UNSEEN | {"white_balance", "picture_blurred"}

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        text = f"The pictures of {name} are {100 * looks.light:.0f} % as bright as in the reference."
        return 1 / max(looks.light, 0.01), text

    remedy = (
        "Light the scene as in the recordings, and fix the exposure and gain of the camera in place of automatic ones."
    )


class PictureBright(_Level):
    """Pictures are brighter."""

    name, title, number, words = "picture_bright", "pictures are not brighter than in the data", "brightness", "bright"
    above, threshold, certain = True, 1.25, 1.7

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        return looks.light, f"The pictures of {name} are {100 * looks.light:.0f} % as bright as in the reference."

    explains = UNSEEN | {"white_balance", "picture_blurred", "picture_covered"}
    remedy = PictureDark.remedy


class PictureBlurred(_Level):
    """Pictures are blurred."""

    name, title, number, words = "picture_blurred", "pictures are as sharp as in the data", "sharpness", "blurred"
    threshold, certain = 1.35, 2.2

    @override
    def compared(self, value: float, low: float, high: float) -> str:
        return f"their details have {100 * value / max(low, 1e-3):.0f} % of the contrast that they have in the data"

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        text = f"The details in pictures of {name} have {100 * looks.sharp:.0f} % of the contrast in the reference."
        return 1 / max(looks.sharp, 0.01), text

    remedy = "Clean the lens and focus it (switch the automatic focus off); a long exposure in dim light blurs, too."


class PictureCovered(PictureCause):
    """A part of the picture is hidden."""

    name, title = "picture_covered", "nothing covers the cameras"
    explains = UNSEEN | {
        "camera_moved", "picture_blurred", "picture_dark", "picture_frozen", "white_balance", "joint_zero",
    }  # fmt: skip
    unit, threshold, certain = "%", 15.0, 35.0
    remedy = "Take away what hangs before the lens: a cable, tape, a hand; or move what stands in the camera's view."

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        share = 100 * looks.covered
        return share, f"In {share:.0f} % of the areas of {name} in which there was something, there is nothing now."

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        if pair.card.rides:
            return self._of_riding(pair)
        middles = [np.median(each, axis=0).mean(axis=2) for each in (pair.camera.sample, pair.card.thumbnails)]
        own, known = (_texture(each) for each in middles)
        rich = known > max(6.0, 0.4 * float(np.median(known)))
        if rich.sum() < 6:
            return None
        lost = rich & (own < 0.3 * known)
        share = 100 * float(lost[rich].mean())
        rest, gone = (np.repeat(np.repeat(each, 4, axis=0), 4, axis=1) for each in (rich & ~lost, lost))
        if gone.any() and middles[0][gone].std() > 4.0 and _agree(middles[0][gone], middles[1][gone]) > 0.6:
            return 0.0, ""  # out of focus: what is large is still there
        other = share < 80 and rest.any() and _agree(middles[0][rest], middles[1][rest]) < 0.5
        shift = shift_between(pair) if share > 10 else None
        if other or (shift is not None and shift.after > 0.45 and shift.after > shift.before + 0.1):
            return 0.0, ""  # another view, not this one with something before it
        text = f"Something covers {share:.0f} % of the picture of {pair.camera.name}: there is nothing to see there."
        return share, text

    @staticmethod
    def _of_riding(pair: Pair) -> tuple[float, str] | None:
        """For a camera on the arm, which sees another part of the scene in each pose."""
        alike = pair.at_like_poses()
        # Without like poses only what nearly always shows something in the data counts, whatever the pose.
        seen, level = (pair.card.thumbnails, 0.1) if alike is None else (alike[1], 0.5)
        known = np.quantile([_texture(each.mean(axis=2)) for each in seen], level, axis=0)
        # An object that the arm does not hold leaves an area empty in some pictures, what covers it in nearly all.
        own = np.quantile([_texture(each.mean(axis=2)) for each in pair.camera.sample], 0.9, axis=0)
        rich = known > max(6.0, 0.4 * float(np.median(known)))
        if rich.sum() < 6:
            return None
        share = max(0.0, 100 * float((own < 0.3 * known)[rich].mean()) - _IN_HAND)
        text = f"Something covers {share:.0f} % of the picture of {pair.camera.name}: there is nothing to see there."
        return share, text


def _agree(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    if min(one.std(), other.std()) < 1e-6:
        return 0.0  # one of them is the same everywhere
    return float(np.corrcoef(one, other)[0, 1])


def _texture(middle: NDArray[np.floating]) -> NDArray[np.float32]:
    """Contrast of 6 x 8 areas of a picture in grey, for a usual brightness."""
    blocks = middle.reshape(6, 4, 8, 4).std(axis=(1, 3))
    return (blocks * 100.0 / (float(middle.mean()) + 5.0)).astype(np.float32)


class PictureFrozen(Cause):
    """Pictures repeat while the arm moves."""

    name = "picture_frozen"
    title = "pictures go on while the arm moves"
    needs = frozenset({"pictures", "state"})
    explains = UNSEEN | {"joint_zero"}
    remedy = (
        "The camera or its driver hangs: look at its cable and USB port, and at `ibrobot doctor`; do not use a hub for "
        "several cameras."
    )

    @override
    def test(self, window: Window, reference: Reference) -> Evidence | None:
        cards = reference.card.cameras if reference.card is not None else {}
        worst: tuple[float, float, Camera, float | None] | None = None
        for key, camera in window.cameras.items():
            seconds, since = repeated_of(window, camera)
            usual = max(0.5, 2.0 * cards[key].repeated_s if key in cards else 0.0)
            if worst is None or seconds / usual > worst[0] / worst[1]:
                worst = seconds, usual, camera, since
        if worst is None:
            return None
        seconds, usual, camera, since = worst
        text = (
            f"The picture of {camera.name} froze: the same one came for {seconds:.1f} s while the arm moved; up to "
            f"{usual:.1f} s are usual."
        )
        # All that is said of its pictures is said of one; but one that is always the same may be dark or covered.
        explains = self.explains | (_OF_ONE if seconds < 0.8 * window.seconds else frozenset())
        return Evidence(
            text, seconds, "s", usual, likelihood(seconds, usual, 3.0 * usual), since, explains=explains
        )  # fmt: skip


_OF_ONE = frozenset({"picture_covered", "picture_dark", "picture_bright", "picture_blurred", "camera_moved"})


class WhiteBalance(PictureCause):
    """Colours are others."""

    name, title = "white_balance", "colours are those of the data"
    unit, threshold, certain = "%", 8.0, 22.0
    remedy = "Fix the white balance of the camera in place of the automatic one, and use the lamps of the recordings."

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        off, colour = max(
            (max(value, 1 / value), colour) for value, colour in ((looks.red, "red"), (looks.blue, "blue"))
        )
        percent = 100 * (off - 1)
        return percent, f"The colours of {name} are off: {colour} differs by {percent:.0f} % from the reference."

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        numbers, worst = numbers_of(pair.camera), (0.0, "red")
        for colour in ("red", "blue"):
            value = float(np.median(numbers[colour]))
            low, high = pair.card.at(colour, 0.0), pair.card.at(colour, 1.0)
            off = max(value / high, low / max(value, 1e-3)) - 1
            worst = max(worst, (100 * off, colour))
        percent, colour = worst
        text = f"The colours of {pair.camera.name} are off: {colour} differs by {percent:.0f} % from that of the data."
        return percent, text


class Bgr(PictureCause):
    """Red and blue are exchanged."""

    name, title = "bgr", "red is red, and blue is blue"
    explains = UNSEEN | {"white_balance", "picture_covered"}
    threshold, certain = 1.07, 1.2  # of nearly all pictures
    of_stills = 1.25, 2.0
    remedy = (
        "Exchange red and blue: the camera delivers BGR as RGB. Set its `encoding`, or that of the contract's image, "
        "as it "
        "was in the recordings."
    )

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        text = f"Red and blue of {name} are exchanged: with them back, colours fit {looks.swapped:.1f} times as well."
        return looks.swapped, text

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        share, ratio = pair.fit_to(pair, lambda small: small[..., ::-1])
        if share < 0.9:
            return None  # some pictures alone may be of scenes that fit the data so by chance
        text = (
            f"Red and blue of {pair.camera.name} are exchanged: with them back, the pictures are {ratio:.1f} times as "
            "close to those of the data."
        )
        return ratio, text


_FLIPS: dict[str, Callable[[Any], Any]] = {
    "upside down": lambda small: small[:, ::-1, ::-1],
    "mirrored": lambda small: small[:, :, ::-1],
    "mirrored upside down": lambda small: small[:, ::-1],
}


class PictureFlipped(PictureCause):
    """The picture is upside down, or mirrored."""

    name, title = "picture_flipped", "pictures are the right way up"
    explains = UNSEEN | {"camera_moved", "joint_zero", "gripper_reversed", "picture_covered"}
    threshold, certain = 1.3, 2.0
    remedy = "Turn the camera, or its picture in the camera's options, as it was in the recordings."

    @override
    def see(self, name: str, looks: Looks) -> tuple[float, str] | None:
        text = f"The picture of {name} is {looks.flip}: turned back, it fits {looks.flipped:.1f} times as well."
        return looks.flipped, text

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        own = pair.distance()
        how, distance = min(((how, pair.distance(flip)) for how, flip in _FLIPS.items()), key=lambda each: each[1])
        ratio = own / max(distance, 1e-3)
        text = (
            f"The picture of {pair.camera.name} is {how}: turned back, it is {ratio:.1f} times as close to those of "
            "the data."
        )
        return ratio, text


class UnseenPictures(PictureCause):
    """The scene does not look as in the data."""

    name, title = "unseen_pictures", "the pictures look like those of the data"
    explains = frozenset()
    unit, threshold, certain = "times", 2.0, 4.0
    remedy = (
        "Make the scene look as in the recordings (background, objects, people in view), or record episodes of this "
        "one."
    )

    @override
    def measure(self, pair: Pair) -> tuple[float, str] | None:
        ratio = pair.distance() / max(pair.card.usual_distance, 0.05)
        text = (
            f"The pictures of {pair.camera.name} look like none of the data: {ratio:.1f} times as far from the nearest "
            "as those are from each other."
        )
        return ratio, text


CAUSES: tuple[type[Cause], ...] = (
    CamerasExchanged, CameraMoved, PictureDark, PictureBright, PictureBlurred, PictureCovered, PictureFrozen,
    WhiteBalance, Bgr, PictureFlipped, UnseenPictures,
)  # fmt: skip
