"""Options of recorder `mcap`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import Options, documented, option

MIB = 1 << 20
COMPRESSIONS = ("none", "lz4", "zstd")


@documented
@attrs.frozen
class McapOptions(Options):
    """Options of writing episodes."""

    compression: str = option("none", choices=COMPRESSIONS, help="compression of chunks; useless for JPEG images")
    chunk_size: int = option(MIB, unit="bytes", ge=1024, le=256 * MIB, help="a chunk of this size is written")
    chunk_period_s: float = option(0.5, unit="s", gt=0, le=60, help="a chunk of this age is written")
    split_size: int | None = option(None, unit="bytes", ge=64 * 1024, help="a file of this size is followed by another")
    split_duration: float | None = option(None, unit="s", gt=0, help="a file of this length is followed by another")
    images: str = option("raw", choices=("raw", "jpeg"), help="how to store rgb8, bgr8 and mono8 images")
    jpeg_quality: int = option(90, ge=1, le=100, help="quality of JPEG images")
    queue_size: int = option(
        256 * MIB, unit="bytes", ge=MIB, help="memory for messages that are not yet written to the disk"
    )
    min_free: int = option(512 * MIB, unit="bytes", ge=0, help="a disk with less free space ends the recording")
    sync_period_s: float | None = option(5.0, unit="s", gt=0, help="time between syncs to the disk; null: at the end")
