"""Pictures of the scene for the operator of blinded trials: as it was at the start of a block, and live."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ibrobot_provenance.asking import Sight
from ibrobot_ros2.jpeg import fits_jpeg, is_jpeg, to_jpeg

from ibrobot_core.api import CompressedImage, Context, IbrobotError, Image, Message, RealClock, Sensor
from ibrobot_core.app import Bus, RobotConfig, Subscription, installed_plugins
from ibrobot_eval.episodes import write

_QUALITY = 85
_PERIOD_S = 0.1
"""Shortest time between two pictures of a camera."""


def cameras_of(config: RobotConfig) -> list[str]:
    """The names of a robot's cameras."""
    return [name for name, each in config.peripherals.items() if each.kind == "camera"]


def as_jpeg(message: Message) -> bytes | None:
    """A camera's picture as JPEG; None for images without colours, e.g. depth."""
    if isinstance(message, CompressedImage):
        return message.data.tobytes() if is_jpeg(message) else None
    if isinstance(message, Image) and fits_jpeg(message):
        return to_jpeg(message, _QUALITY).data.tobytes()
    return None


class StartPictures:
    """Pictures of the scene at the start of a block, one of each camera: the first of a run.

    Args:
        folder: the folder for the pictures.
        cameras: names of the cameras.
    """

    def __init__(self, folder: Path, cameras: list[str]) -> None:
        self._files = {name: folder / f"{name}.jpg" for name in cameras}

    def sights(self, live: Path) -> list[Sight]:
        """The pictures to show: for each camera that of the start, the live one, or both.

        Args:
            live: folder of the live pictures; it need not exist.
        """
        sights = []
        for name, file in self._files.items():
            wanted = str(file) if file.exists() else ""
            now = live / file.name
            present = str(now) if now.exists() else ""
            if wanted or present:
                sights.append(Sight(camera=name, wanted=wanted, live=present))
        return sights

    def taken(self, bus: Bus) -> TakenPictures:
        """Take new pictures from a run, in place of the old ones."""
        return TakenPictures(bus, self._files)


class TakenPictures:
    """Writes the first picture of each camera in a run."""

    def __init__(self, bus: Bus, files: dict[str, Path]) -> None:
        self._todo: dict[Path, Subscription] = {
            file: bus.subscribe(f"/camera/{name}/image_raw", 1) for name, file in files.items()
        }

    def take(self) -> None:
        """Write the pictures that have arrived."""
        for file, images in tuple(self._todo.items()):
            for each in images.drain():
                if (content := as_jpeg(each.message)) is not None:
                    write(file, content)
                    del self._todo[file]
                    break


@contextmanager
def live_pictures(config: RobotConfig, folder: Path) -> Iterator[str]:
    """Keep one file per camera up to date with its newest picture, while the robot does not run.

    Yields:
        The faults of cameras, in words; empty without faults.
    """
    registry, clock = installed_plugins(), RealClock()
    problems: list[str] = []
    ended = threading.Event()
    with ExitStack() as stack:
        for name in cameras_of(config):
            file, ready = folder / f"{name}.jpg", threading.Event()
            file.parent.mkdir(parents=True, exist_ok=True)
            peripheral = config.peripherals[name]
            made = registry.create("sensor", peripheral.type, peripheral.options, Context.of(config, name, clock))
            thread = threading.Thread(
                target=_follow, args=(made, name, file, ready, ended, problems), name=f"live {name}", daemon=True
            )
            thread.start()
            stack.callback(thread.join)
            stack.callback(ended.set)
            ready.wait()
        yield "; ".join(problems)


def _follow(
    sensor: Sensor, name: str, file: Path, ready: threading.Event, ended: threading.Event, problems: list[str]
) -> None:
    """Write the pictures of a camera until `ended`; set `ready` after the first one or a fault."""
    staged = file.with_suffix(".new")
    try:
        sensor.open()
        while not ended.is_set():
            message = sensor.read(1.0)
            if message is not None and (content := as_jpeg(message)) is not None:
                staged.write_bytes(content)
                staged.replace(file)
            ready.set()
            ended.wait(_PERIOD_S)
    except IbrobotError as error:
        problems.append(f"{name}: {error}")
    finally:
        ready.set()
        sensor.close()
        for each in (staged, file):
            with suppress(FileNotFoundError):
                each.unlink()
