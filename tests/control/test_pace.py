"""A loop that keeps missing ticks says so, with how long the hardware is read."""

from __future__ import annotations

import pytest

from ibrobot_core.control.timing import Pace

PERIOD_NS = 10_000_000
SLOW = "the control loop runs at 20 Hz instead of 100 Hz: reading the joints takes 50.0 ms of 10.0 ms"


def run(pace: Pace, seconds: float, periods: int, reading_ns: int = 1_000_000) -> list[str]:
    """What a loop says that runs every so many periods."""
    said = [pace.tick(periods, reading_ns) for _ in range(round(seconds * 100 / periods))]
    return [line for line in said if line]


def test_loop_on_time_says_nothing():
    pace = Pace(PERIOD_NS)
    assert run(pace, 10, 1) == []
    assert pace.slow_seconds == 0


def test_slow_loop_says_so_once_until_it_was_on_time_again():
    pace = Pace(PERIOD_NS)
    assert run(pace, 3, 5, 50_000_000) == [SLOW]
    assert pace.slow_seconds == 3
    run(pace, 2, 1)
    assert run(pace, 2, 5, 50_000_000) == [SLOW]
    assert pace.slow_seconds == 5


def test_slow_loop_that_reads_quickly_blames_the_machine():
    (said,) = run(Pace(PERIOD_NS), 3, 5, 300_000)
    assert said == (
        "the control loop runs at 20 Hz instead of 100 Hz: the machine is busy with other work (reading the joints "
        "takes 0.3 ms of 10.0 ms); `ibrobot doctor` says how to get priority"
    )


def test_single_missed_ticks_are_no_slow_loop():
    pace = Pace(PERIOD_NS)
    for _ in range(100):
        assert pace.tick(5, 50_000_000) == ""
        assert run(pace, 0.95, 1) == []
    assert pace.slow_seconds == 0


def test_read_that_blocks_is_reported_at_run_time(make_rig, monkeypatch, caplog: pytest.LogCaptureFixture):
    rig = make_rig({}).start()
    read = rig.hardware.read

    def slow_read():
        rig.clock.advance(50_000_000)
        return read()

    monkeypatch.setattr(rig.hardware, "read", slow_read)
    for _ in range(25):
        rig.core.tick(periods=5)
    assert "the control loop runs at 21 Hz instead of 100 Hz: reading the joints takes 47.6 ms" in caplog.text
    assert rig.core.counters()["loop"]["slow_seconds"] == 1
