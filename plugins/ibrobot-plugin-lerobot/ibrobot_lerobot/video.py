"""Videos: pictures encoded one by one in a thread of their own, and files joined without re-encoding."""

from __future__ import annotations

import os
import threading
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from queue import Full, Queue
from typing import Any

import attrs
import av
import av.error
import numpy as np
from numpy.typing import NDArray

from ibrobot_core.api import DatasetError
from ibrobot_lerobot.options import LeRobotOptions
from ibrobot_lerobot.stats import PixelStats

PIXEL_FORMAT = "yuv420p"
_GPU = ("h264_nvenc", "hevc_nvenc", "h264_videotoolbox", "hevc_videotoolbox")
_QUEUED = 8
"""Pictures that may wait for their encoder; a writer that is faster waits."""
_SVT_PRESET = "12"

os.environ.setdefault("SVT_LOG", "1")  # libsvtav1 tells about every file on stderr otherwise


@attrs.frozen
class Encoder:
    """An encoder and its options."""

    codec: str
    options: dict[str, str]
    described: dict[str, Any]
    """What `info.json` says of it, by LeRobot's names."""


def choose_encoder(options: LeRobotOptions) -> Encoder:
    """The encoder that the options ask for.

    Raises:
        DatasetError: when it does not open on this machine.
    """
    if options.codec == "auto":
        found = (encoder for codec in _GPU if _opens(encoder := _encoder(codec, options)) is None)
        return next(found, None) or _encoder("libsvtav1", options)
    encoder = _encoder(options.codec, options)
    if (reason := _opens(encoder)) is not None:
        raise DatasetError(
            f"codec {encoder.codec} does not open here: {reason}; codec: auto takes the first that does, "
            "libsvtav1 needs no GPU"
        )
    return encoder


def _encoder(codec: str, options: LeRobotOptions) -> Encoder:
    preset = options.preset or (_SVT_PRESET if codec == "libsvtav1" else "")
    told = {"g": str(options.gop)} | ({"preset": preset} if preset else {})
    described: dict[str, Any] = {
        "video.g": options.gop, "video.crf": options.crf,
        "video.preset": int(preset) if preset.isdigit() else preset or None,
        "video.fast_decode": 0, "video.video_backend": "pyav", "video.extra_options": {},
    }  # fmt: skip
    if codec == "libsvtav1":
        told |= {"crf": str(options.crf), "svtav1-params": f"fast-decode=0:lp={options.threads}"}
        return Encoder(codec, told, described)
    # Pictures in the order of display, so that files can be joined at any of them.
    told["bf"] = "0"
    if codec in ("h264", "hevc"):
        told |= {"crf": str(options.crf), "threads": str(options.threads)}
        if codec == "hevc":
            told["x265-params"] = f"log-level=error:bframes=0:pools={options.threads}"
    elif codec.endswith("nvenc"):
        told |= {"rc": "constqp", "qp": str(options.crf)}
    else:
        told["q:v"] = str(max(1, 100 - 2 * options.crf))
    return Encoder(codec, told, described)


def _opens(encoder: Encoder) -> str | None:
    """Why an encoder does not encode a picture here; None when it does."""
    try:
        context: Any = av.CodecContext.create(encoder.codec, "w")
        context.width, context.height, context.pix_fmt = 256, 256, PIXEL_FORMAT
        context.time_base, context.framerate = Fraction(1, 30), Fraction(30)
        context.options = encoder.options
        context.encode(av.VideoFrame(256, 256, PIXEL_FORMAT))
        context.encode(None)
    except (av.error.FFmpegError, ValueError) as error:
        return str(error)
    return None


class VideoTrack:
    """One camera's pictures of an episode, on their way into a file. No picture is ever dropped: `add` waits.

    Args:
        path: the file, which must not exist.
        fps: pictures per second.
        shape: (H, W, 3) of every picture.
        encoder: how to encode them.

    Raises:
        DatasetError: when the file cannot be made.
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
        """Append a picture, shape (H, W, 3), RGB; it is copied.

        Raises:
            DatasetError: when an earlier one could not be written.
        """
        frame: Any = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), "rgb24")
        frame.pts, frame.time_base = self._count, self._time_base
        self._count += 1
        self._put(frame)

    def close(self) -> PixelStats:
        """Finish the file; returns the statistics of its pixels.

        Raises:
            DatasetError: when a picture could not be written.
        """
        self._put(None)
        self._thread.join()
        if self._failure is not None:
            raise self._failed()
        return self._stats

    def abort(self) -> None:
        """Give the file up. Safe after `close`."""
        self._failure = self._failure or DatasetError("given up")
        while self._thread.is_alive():
            try:
                self._queue.put(None, timeout=0.05)
            except Full:
                continue
            self._thread.join(0.05)

    def _put(self, frame: Any) -> None:
        while True:
            if self._failure is not None:
                raise self._failed()
            try:
                self._queue.put(frame, timeout=0.5)
            except Full:
                continue
            return

    def _failed(self) -> DatasetError:
        return DatasetError(f"{self._path}: picture {self._count} could not be encoded or written: {self._failure}")

    def _run(self) -> None:
        try:
            with self._container:
                while (frame := self._queue.get()) is not None:
                    if self._failure is not None:
                        self._stream.encode(None)  # an encoder that is not flushed complains on stderr
                        return
                    self._stats.add(frame.to_ndarray())
                    self._container.mux(self._stream.encode(frame))
                self._container.mux(self._stream.encode(None))
        except Exception as error:  # noqa: BLE001 - contained: raised where the next picture is added
            self._failure = error


@attrs.frozen
class VideoFile:
    """A part of a video to be."""

    path: Path
    frames: int


def join_videos(parts: Sequence[VideoFile], path: Path, fps: int) -> None:
    """Write the pictures of `parts` one after the other, as they are encoded.

    Args:
        parts: videos of the same encoder and size, with the pictures that each has.
        path: the new file.
        fps: pictures per second.

    Raises:
        DatasetError: for a part that cannot be read or has another number of pictures, or a full disk.
    """
    begin = 0
    stream: Any = None
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as joined:
            for part in parts:
                with av.open(str(part.path)) as container:
                    source: Any = container.streams.video[0]
                    if stream is None:
                        stream = joined.add_stream_from_template(source, opaque=True)
                        stream.time_base = source.time_base
                    offset = round(begin / (fps * source.time_base))
                    found = 0
                    for packet in container.demux(source):
                        if packet.dts is None:
                            continue
                        packet.pts, packet.dts = packet.pts + offset, packet.dts + offset
                        packet.stream = stream
                        joined.mux(packet)
                        found += 1
                if found != part.frames:
                    raise DatasetError(f"{part.path}: has {found} pictures, its table {part.frames} rows")
                begin += part.frames
    except (av.error.FFmpegError, OSError) as error:
        raise DatasetError(f"{path}: cannot be joined: {error}") from error


def describe_video(path: Path, fps: int, encoder: Encoder) -> dict[str, Any]:
    """What `info.json` says of a video, by LeRobot's names."""
    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        return {
            "video.height": stream.height, "video.width": stream.width, "video.codec": stream.codec.canonical_name,
            "video.pix_fmt": stream.pix_fmt, "video.fps": fps, "video.channels": 3, "has_audio": False,
            **encoder.described, "is_depth_map": False,
        }  # fmt: skip
