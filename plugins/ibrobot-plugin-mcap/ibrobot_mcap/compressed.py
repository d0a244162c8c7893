"""rosbag2's own compression of whole files or single messages, as opposed to that of MCAP chunks."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import override

import attrs
import zstandard

from ibrobot_mcap.damage import reading
from ibrobot_mcap.sources import Raw, Source

_BLOCK = 1 << 20


class Expanded:
    """Decompressed files, in a temporary folder until `close`."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._folder = TemporaryDirectory(prefix="ibrobot-bag-")
        self.paths: list[Path] = []
        try:
            for path in paths:
                target = Path(self._folder.name) / path.stem
                with reading(path):
                    _expand_file(path, target)
                self.paths.append(target)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the files. Safe to call twice."""
        self._folder.cleanup()


class MessageCompressed(Source):
    """A source whose messages are compressed individually."""

    def __init__(self, path: Path, source: Source) -> None:
        self._path, self._source = path, source
        self.finished, self.custom, self.types = source.finished, source.custom, source.types
        self.counts, self.stated, self.repeated = source.counts, source.stated, source.repeated
        self.definitions, self.encodings = source.definitions, source.encodings
        self.latched, self.start_ns, self.end_ns = source.latched, source.start_ns, source.end_ns

    @override
    def messages(self, topics: Collection[str], since_ns: int = 0) -> Iterator[Raw]:
        for raw in self._source.messages(topics, since_ns):
            with reading(self._path):
                data = _expand_message(raw.data)
            yield attrs.evolve(raw, data=data)

    @override
    def close(self) -> None:
        self._source.close()


def _expand_file(path: Path, target: Path) -> None:
    expander = zstandard.ZstdDecompressor().decompressobj()
    with path.open("rb") as compressed, target.open("wb") as expanded:
        while block := compressed.read(_BLOCK):
            expanded.write(expander.decompress(block))
    if not expander.eof:
        raise EOFError("its compressed content ends early")


def _expand_message(data: bytes) -> bytes:
    expander = zstandard.ZstdDecompressor().decompressobj()
    expanded = expander.decompress(data)
    if not expander.eof:
        raise EOFError("a compressed message ends early")
    return expanded
