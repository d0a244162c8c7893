"""Options of the dataset writer and of the policy `lerobot`; the writer's defaults are LeRobot's own."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.api import documented, option

CODECS = ("libsvtav1", "h264", "hevc", "h264_nvenc", "hevc_nvenc", "h264_videotoolbox", "hevc_videotoolbox")
"""Encoders by LeRobot's names; those from `h264_nvenc` on need a GPU."""


@documented
@attrs.frozen
class LeRobotOptions:
    """How pictures are stored, and how large files become."""

    videos: bool = option(True, help="cameras as videos; false: as PNG pictures in the tables, without loss")
    codec: str = option(
        "libsvtav1", choices=("auto", *CODECS), help="video encoder; auto: a GPU's where one opens, else libsvtav1"
    )
    crf: int = option(30, ge=0, le=63, help="quality of videos; lower is better and larger")
    preset: str = option(
        "", help="the encoder's own name for speed against size; empty: 12 for libsvtav1, else its own"
    )
    gop: int = option(2, unit="pictures", ge=1, help="from key picture to key picture; short ones are found quickly")
    threads: int = option(1, ge=1, help="threads of each encoder; equal numbers give equal bytes")
    table_file_mb: int = option(100, unit="MiB", ge=1, help="size at which a new table begins")
    video_file_mb: int = option(200, unit="MiB", ge=1, help="size at which a new video begins")


@documented
@attrs.frozen
class LeRobotPolicyOptions:
    """Which checkpoint, and how it is computed."""

    path: Path = option(help="folder of the checkpoint: config.json, the processors, and to load it, model.safetensors")
    device: str = option(
        "auto", choices=("auto", "cuda", "mps", "cpu"), help="auto: a GPU where there is one, else the CPU"
    )
    dtype: str = option(
        "auto", choices=("auto", "float32", "bfloat16", "float16"),
        help="of the arithmetic; auto: as the checkpoint has it",
    )  # fmt: skip
    compile: bool = option(False, help="torch.compile: a slow start, then faster")
    threads: int | None = option(
        None, ge=1, help="CPU threads of torch; by default one less than the cores, at least 1"
    )
    n_action_steps: int | None = option(None, ge=1, help="actions of a chunk that are used; by default all")
    base_models: tuple[str, ...] = option(
        (),
        help="models or folders that the checkpoint may load besides itself; not needed for LeRobot's own",
    )
