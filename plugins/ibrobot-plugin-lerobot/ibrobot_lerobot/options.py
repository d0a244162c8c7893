"""Options of the dataset writer and of the policy `lerobot`; the writer's defaults are LeRobot's own."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.api import Options, documented, option

CODECS = ("libsvtav1", "h264", "hevc", "h264_nvenc", "hevc_nvenc", "h264_videotoolbox", "hevc_videotoolbox")
"""Encoders by LeRobot's names; those from `h264_nvenc` on need a GPU."""


@documented
@attrs.frozen
class LeRobotOptions(Options):
    """Image storage and file sizes."""

    videos: bool = option(True, help="store images as videos; false: as lossless PNG in the tables")
    codec: str = option(
        "libsvtav1", choices=("auto", *CODECS), help="video encoder; auto: a GPU's if available, else libsvtav1"
    )
    crf: int = option(30, ge=0, le=63, help="video quality; lower values give better quality and larger files")
    preset: str = option("", help="the encoder's speed preset; empty: 12 for libsvtav1, else the encoder's default")
    gop: int = option(2, unit="frames", ge=1, help="distance between key frames; a short one makes random access fast")
    threads: int = option(1, ge=1, help="threads per encoder; the same number gives the same bytes")
    table_file_mb: int = option(100, unit="MiB", ge=1, help="size at which a new table file begins")
    video_file_mb: int = option(200, unit="MiB", ge=1, help="size at which a new video file begins")


@documented
@attrs.frozen
class LeRobotPolicyOptions(Options):
    """Checkpoint, device and precision."""

    path: Path = option(help="folder of the checkpoint: config.json, processors and, for inference, model.safetensors")
    device: str = option("auto", choices=("auto", "cuda", "mps", "cpu"), help="auto: a GPU if available, else the CPU")
    dtype: str = option(
        "auto",
        choices=("auto", "float32", "bfloat16", "float16"),
        help="precision of the computation; auto: the checkpoint's",
    )
    compile: bool = option(False, help="use torch.compile: slow to load, faster inference")
    threads: int | None = option(
        None, ge=1, help="CPU threads of torch; by default one fewer than the cores, at least 1"
    )
    n_action_steps: int | None = option(None, ge=1, help="number of actions of a chunk to use; by default all")
    attention: bool = option(
        True, help="publish what an ACT attends to in each picture on /attention/CAMERA, for the page and recordings"
    )
    untested: str = option(
        "warn", choices=("warn", "refuse"), help="what to do with a LeRobot that is not one of the tested versions"
    )
    base_models: tuple[str, ...] = option(
        (),
        help="additional models or folders that the checkpoint may load; LeRobot's own are always allowed",
    )
