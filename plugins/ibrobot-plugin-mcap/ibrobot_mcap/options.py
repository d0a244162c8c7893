"""Options of recorder `mcap`."""

from __future__ import annotations

import attrs

from ibrobot_core.api import documented, option

MIB = 1 << 20
COMPRESSIONS = ("none", "lz4", "zstd")


@documented
@attrs.frozen
class McapOptions:
    """How episodes are written."""

    compression: str = option("none", choices=COMPRESSIONS, help="of chunks; JPEG pictures gain nothing")
    chunk_size: int = option(MIB, unit="bytes", ge=1024, le=256 * MIB, help="a chunk of this size is written")
    chunk_period_s: float = option(0.5, unit="s", gt=0, le=60, help="a chunk as old as this is written")
    split_size: int | None = option(None, unit="bytes", ge=64 * 1024, help="a file of this size is followed by another")
    split_duration: float | None = option(None, unit="s", gt=0, help="a file as long as this is followed by another")
    images: str = option("raw", choices=("raw", "jpeg"), help="how rgb8, bgr8 and mono8 pictures are kept")
    jpeg_quality: int = option(90, ge=1, le=100, help="of JPEG pictures")
    queue_size: int = option(256 * MIB, unit="bytes", ge=MIB, help="memory for what the disk has not taken yet")
    min_free: int = option(512 * MIB, unit="bytes", ge=0, help="space on the disk that ends the recording")
    sync_period_s: float | None = option(5.0, unit="s", gt=0, help="time between syncs to the disk; null: at the end")
