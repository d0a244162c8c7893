"""Output streams that never block their writers, on pipes that nobody reads."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Iterator

import pytest

from ibrobot_core.output_thread import AsideStream, output_aside

PATIENCE_S = 30.0
FULL = 70_000
"""More than a pipe takes [bytes]."""

pytestmark = pytest.mark.integration  # it exchanges the standard streams of its process


@pytest.fixture
def pipe() -> Iterator[tuple[io.FileIO, io.TextIOWrapper]]:
    """The reading end of a pipe, and a stream at its writing end."""
    read, write = os.pipe()
    reader, stream = io.FileIO(read), io.TextIOWrapper(io.FileIO(write, "w"), "utf-8", write_through=True)
    yield reader, stream
    reader.close()
    stream.close()


def read_all(reader: io.FileIO, stream: io.TextIOWrapper) -> str:
    stream.close()
    return reader.readall().decode()


def test_all_that_is_written_arrives_in_order(pipe):
    reader, stream = pipe
    aside = AsideStream(stream)
    for number in range(1000):
        print(number, file=aside)

    assert aside.end(PATIENCE_S)
    assert read_all(reader, stream) == "".join(f"{number}\n" for number in range(1000))


def test_writing_to_a_full_pipe_does_not_wait_and_what_is_dropped_is_counted(pipe):
    reader, stream = pipe
    aside = AsideStream(stream, most=100)
    aside.write("x" * 100)
    while not aside.dropped:
        aside.write("y" * 90 + "\n")
    assert not aside.end(0.0)
    read = b""
    while b"dropped" not in read:
        read += reader.read(FULL)

    assert aside.end(PATIENCE_S)
    assert read.endswith(b"(nothing read this output; messages dropped: 1)\n")


def test_a_reader_that_is_gone_is_an_error_for_the_next_writer(pipe):
    reader, stream = pipe
    aside = AsideStream(stream)
    reader.close()
    aside.write("lost")
    assert aside.end(PATIENCE_S)

    with pytest.raises(BrokenPipeError):
        aside.write("too late")


def test_it_says_what_its_stream_is(pipe):
    _, stream = pipe
    aside = AsideStream(stream)

    assert (aside.fileno(), aside.isatty(), aside.encoding, aside.errors) == (
        stream.fileno(),
        False,
        "utf-8",
        "strict",
    )
    assert aside.writable()
    aside.end(PATIENCE_S)


def test_what_is_not_read_in_time_is_given_up_so_that_the_process_can_end(pipe, monkeypatch):
    _, stream = pipe
    monkeypatch.setattr(sys, "stdout", stream)
    with output_aside(lambda: 0.0):
        print("x" * FULL)
    print("x" * FULL)  # does not wait either

    assert sys.stdout is stream


def test_streams_without_a_file_stay_as_they_are(monkeypatch):
    monkeypatch.setattr(sys, "stdout", memory := io.StringIO())
    with output_aside():
        assert sys.stdout is memory
