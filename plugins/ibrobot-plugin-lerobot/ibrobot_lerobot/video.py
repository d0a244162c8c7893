"""Videos: encodes images in a thread, and joins files without re-encoding."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from queue import Queue
from typing import Any

import attrs
import av
import av.error
import numpy as np
from ibrobot_terminal.plural import counted
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.stats import PixelStats

PIXEL_FORMAT = "yuv420p"
_GPU = ("h264_nvenc", "hevc_nvenc", "h264_videotoolbox", "hevc_videotoolbox")
_QUEUED = 8
"""Most images queued for their encoder; then the writer waits."""
_SVT_PRESET = "12"

os.environ.setdefault("SVT_LOG", "1")  # otherwise libsvtav1 logs every file to stderr


@attrs.frozen
class Encoder:
    """An encoder and its options."""

    codec: str
    options: dict[str, str]
    described: dict[str, Any]
    """Its description in `info.json`, with LeRobot's names."""


def choose_encoder(options: LeRobotOptions, shapes: Collection[Sequence[int]] = ()) -> Encoder:
    """The encoder selected by the options.

    Args:
        options: the codec and its settings.
        shapes: shapes of the images, (H, W, 3).

    Raises:
        DatasetError: if it is not available on this machine, or cannot encode images of these sizes.
    """
    if options.codec == "auto":
        encoders = (_encoder(codec, options) for codec in _GPU)
        usable = (each for each in encoders if _opens(each) is None and not _misfits(each, shapes))
        return next(usable, None) or _encoder("libsvtav1", options)
    encoder = _encoder(options.codec, options)
    if (reason := _opens(encoder)) is not None:
        raise DatasetError(
            f"codec {encoder.codec} is not available: {reason}; codec: auto uses the first available one, "
            "libsvtav1 needs no GPU"
        )
    if misfits := _misfits(encoder, shapes):
        raise DatasetError(
            f"codec {encoder.codec} cannot encode images of {' and '.join(misfits)}: it needs even sizes; use "
            "libsvtav1, or resize the images (contract.observations: image.resize)"
        )
    return encoder


def _misfits(encoder: Encoder, shapes: Collection[Sequence[int]]) -> list[str]:
    """Odd image sizes that an encoder cannot encode, found with small images of such sizes."""
    odd = [(height, width) for height, width, *_ in shapes if height % 2 or width % 2]
    return [f"{w}x{h}" for h, w in odd if _opens(encoder, 256 + h % 2, 256 + w % 2) is not None]


def _encoder(codec: str, options: LeRobotOptions) -> Encoder:
    preset = options.preset or (_SVT_PRESET if codec == "libsvtav1" else "")
    settings = {"g": str(options.gop)} | ({"preset": preset} if preset else {})
    described: dict[str, Any] = {
        "video.g": options.gop,
        "video.crf": options.crf,
        "video.preset": int(preset) if preset.isdigit() else preset or None,
        "video.fast_decode": 0,
        "video.video_backend": "pyav",
        "video.extra_options": {},
    }
    if codec == "libsvtav1":
        settings |= {"crf": str(options.crf), "svtav1-params": f"fast-decode=0:lp={options.threads}"}
        return Encoder(codec, settings, described)
    # Keep images in display order, so that files can be joined anywhere.
    settings["bf"] = "0"
    if codec in ("h264", "hevc"):
        settings |= {"crf": str(options.crf), "threads": str(options.threads)}
        if codec == "hevc":
            settings["x265-params"] = f"log-level=error:bframes=0:pools={options.threads}"
        else:
            settings["x264-params"] = "cpu-independent=1"  # otherwise, now and then the bytes differ
    elif codec.endswith("nvenc"):
        settings |= {"rc": "constqp", "qp": str(options.crf)}
    else:
        settings["q:v"] = str(max(1, 100 - 2 * options.crf))
    return Encoder(codec, settings, described)


def _opens(encoder: Encoder, height: int = 256, width: int = 256) -> str | None:
    """The reason why an encoder does not work on this machine, for images of this size; None if it works."""
    try:
        context: Any = av.CodecContext.create(encoder.codec, "w")
        context.width, context.height, context.pix_fmt = width, height, PIXEL_FORMAT
        context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
        context.options = encoder.options
        with _same_priority():
            context.open()
        context.encode(av.VideoFrame(width, height, PIXEL_FORMAT))
        context.encode(None)
    except (av.error.FFmpegError, ValueError) as error:
        return str(error)
    return None


@contextmanager
def _same_priority() -> Iterator[None]:
    """Keep the scheduling of this thread, and give it to the threads started meanwhile.

    As root, libsvtav1 sets SCHED_FIFO 99 for the thread that opens it. Its own threads, and later threads and processes
    of this one, inherit it: they would take precedence over the control loop of a robot.
    """
    if sys.platform != "linux":
        yield
        return
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    before = set(os.listdir("/proc/self/task"))
    try:
        yield
    finally:
        started = set(os.listdir("/proc/self/task")) - before
        for thread in (threading.get_native_id(), *map(int, started)):
            with suppress(ProcessLookupError):  # it has ended
                if os.sched_getscheduler(thread) == os.SCHED_FIFO:
                    os.sched_setscheduler(thread, policy, param)


class VideoTrack:
    """Writes the images of one camera in an episode to a file. No image is ever dropped: `add` waits.

    Args:
        path: the file, which must not exist.
        fps: pictures per second.
        shape: image shape, (H, W, 3).
        encoder: the encoder.

    Raises:
        DatasetError: if the file cannot be created.
    """

    def __init__(self, path: Path, fps: int, shape: tuple[int, ...], encoder: Encoder) -> None:
        self._path = path
        self._stats = PixelStats(shape[2])
        self._count = 0
        self._failure: Exception | None = None
        self._queue: Queue[Any] = Queue(_QUEUED)
        try:
            self._container: Any = av.open(str(path), "w", format="mp4")
            stream: Any = self._container.add_stream(encoder.codec, fps, options=encoder.options)
        except (av.error.FFmpegError, ValueError) as error:
            raise DatasetError(f"{path}: {error}") from error
        stream.height, stream.width = shape[:2]
        stream.pix_fmt = PIXEL_FORMAT
        stream.time_base = self._time_base = Fraction(1, fps)
        self._stream = stream
        self._thread = threading.Thread(target=self._run, name=f"encode {path.name}", daemon=True)
        self._thread.start()

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append an image, shape (H, W, 3), RGB; it is copied.

        Raises:
            DatasetError: if an earlier one could not be written.
        """
        frame: Any = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
        frame.pts, frame.time_base = self._count, self._time_base
        self._count += 1
        self._put(frame)

    def close(self) -> PixelStats:
        """Finish the file; returns the statistics of its pixels.

        Raises:
            DatasetError: if an image could not be written.
        """
        self._put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failed()
        return self._stats

    def abort(self) -> None:
        """Discard the file. Safe after `close`."""
        self._failure = self._failure or DatasetError("given up")
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def _put(self, frame: Any) -> None:
        if self._failure is not None:
            raise self._failed()
        self._queue.put(frame)

    def _failed(self) -> DatasetError:
        return DatasetError(f"{self._path}: image {self._count} could not be encoded or written: {self._failure}")

    def _run(self) -> None:
        frames = iter(self._queue.get, None)
        try:
            with self._container:
                with _same_priority():
                    self._stream.codec_context.open()
                for frame in frames:
                    if self._failure is not None:
                        break
                    self._stats.add(frame.to_ndarray())
                    self._container.mux(self._stream.encode(frame))
                self._container.mux(self._stream.encode(None))  # or the encoder prints warnings to stderr
        except Exception as error:  # noqa: BLE001 - the next `add` raises it
            self._failure = error
        for _ in frames:  # so that `add` does not wait
            pass


def join_videos(parts: Sequence[tuple[Path, int]], path: Path, fps: float) -> None:
    """Join videos without re-encoding.

    Args:
        parts: videos of the same encoder and size, with their numbers of images.
        path: the new file.
        fps: images per second.

    Raises:
        DatasetError: if a part cannot be read, has an unexpected number of images or another codec than the others, or
            the disk is full.
    """
    begin = 0
    stream: Any = None
    first: tuple[Any, ...] = ()
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as joined:
            for part, frames in parts:
                with av.open(str(part)) as container:
                    source: Any = container.streams.video[0]
                    coded = source.codec.canonical_name, source.width, source.height, source.pix_fmt
                    first = first or coded
                    if coded != first:
                        raise DatasetError(f"{part}: is {_words(coded)}, the videos before it are {_words(first)}")
                    if stream is None:
                        stream = joined.add_stream_from_template(source, opaque=True)
                        stream.time_base = source.time_base
                    offset = round(begin / (fps * float(source.time_base)))
                    count = 0
                    for packet in container.demux(source):
                        if packet.dts is None:
                            continue
                        packet.pts, packet.dts = packet.pts + offset, packet.dts + offset
                        packet.stream = stream
                        joined.mux(packet)
                        count += 1
                if count != frames:
                    raise DatasetError(f"{part}: has {counted(count, 'image')}, its table {frames} rows")
                begin += frames
    except (av.error.FFmpegError, OSError) as error:
        raise DatasetError(f"{path}: cannot be joined: {error}") from error


def _words(coded: tuple[Any, ...]) -> str:
    codec, width, height, pixels = coded
    return f"{codec} of {width}x{height} {pixels}"


def describe_video(path: Path, fps: int, encoder: Encoder) -> dict[str, Any]:
    """The description of a video in `info.json`, with LeRobot's names."""
    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        return {
            "video.height": stream.height, "video.width": stream.width, "video.codec": stream.codec.canonical_name,
            "video.pix_fmt": stream.pix_fmt, "video.fps": fps, "video.channels": 3, "has_audio": False,
            **encoder.described, "is_depth_map": False,
        }  # fmt: skip
