"""SVG plots in the colours of the page: `--ok` and `--bad` for outcomes, which also differ by their marks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

import attrs
from ibrobot_provenance.svg import Axis, axis_of, caption, grid_below, grid_beside, stroke, svg, tag

from ibrobot_eval.statistics import clopper_pearson

WIDTH = 720
_LEFT, _RIGHT, _TOP, _BOTTOM = 48, 12, 8, 34
_BINS = 5


def mark(x: float, y: float, success: bool, tip: str) -> str:
    """Mark of an episode's outcome: a dot for a success, a cross for a failure."""
    if success:
        return tag("circle", tag("title", escape(tip)), cx=x, cy=y, r=3.5, class_="ok")
    path = f"M{x - 3.5:.1f},{y - 3.5:.1f}l7,7m0,-7l-7,7"
    return tag("path", tag("title", escape(tip)), d=path, class_="bad")


def _margin(labels: Iterable[str]) -> int:
    """Width for the labels of policies [px]."""
    return 24 + 7 * max(map(len, labels))


def rates(rows: Sequence[tuple[str, int, int]]) -> str:
    """Plot success rates with intervals.

    Args:
        rows: label, number of successes and number of episodes of each policy.
    """
    left = _margin(label for label, _, _ in rows)
    height = _TOP + 30 * len(rows) + _BOTTOM
    axis = Axis(0, 100, left, WIDTH - _RIGHT)
    parts = grid_below(axis, _TOP, height - _BOTTOM, "success rate [%], with 95 % interval")
    for number, (label, successes, episodes) in enumerate(rows):
        y = _TOP + 30 * number + 15
        interval = clopper_pearson(successes, episodes)
        parts += [
            caption(left - 10, y + 4, label, "end"),
            stroke(axis(100 * interval.low), y, axis(100 * interval.high), y, "range"),
            mark(axis(100 * successes / episodes), y, True, f"{label}: {successes} of {episodes}"),
        ]
    return svg(WIDTH, height, parts, "Success rates with intervals")


def course(points: Sequence[tuple[int, float, float, float]], margin: float, title: str) -> str:
    """Plot the difference of success rates over the number of episodes.

    Args:
        points: number of episodes, difference, and the ends of the anytime-valid interval.
        margin: drawn as dashed lines.
        title: for screen readers.
    """
    height = 230
    across = Axis(0, max(points[-1][0], 1), _LEFT, WIDTH - _RIGHT)
    up = Axis(-100, 100, height - _BOTTOM, _TOP)
    parts = [*grid_below(across, _TOP, height - _BOTTOM, "episodes"), *grid_beside(up, _LEFT, WIDTH - _RIGHT)]
    upper = [f"{across(n)},{up(100 * high)}" for n, _, _, high in points]
    lower = [f"{across(n)},{up(100 * low)}" for n, _, low, _ in reversed(points)]
    parts.append(tag("polygon", points=" ".join([*upper, *lower]), class_="band"))
    for value, name in ((0.0, "zero"), (margin, "margin"), (-margin, "margin")):
        parts.append(stroke(_LEFT, up(100 * value), WIDTH - _RIGHT, up(100 * value), name))
    estimate = " ".join(f"{across(n)},{up(100 * difference)}" for n, difference, _, _ in points)
    parts.append(tag("polyline", points=estimate, class_="estimate"))
    return svg(WIDTH, height, parts, title)


def strips(rows: Sequence[tuple[str, Sequence[tuple[int, bool, float, str]]]]) -> str:
    """Plot outcomes by seed.

    Args:
        rows: label of each policy, with seed, success, duration [s] and error of each episode.
    """
    left = _margin(label for label, _ in rows)
    count = max(len(episodes) for _, episodes in rows)
    step = min(24.0, (WIDTH - left - _RIGHT) / count)
    parts = []
    for number, (label, episodes) in enumerate(rows):
        y = _TOP + 30 * number
        parts.append(caption(left - 10, y + 16, label, "end"))
        for place, (seed, success, time_s, error) in enumerate(episodes):
            broken = bool(error) and not success
            ended = f"error: {error}" if broken else f"{'success' if success else 'failure'} after {time_s:.1f} s"
            tip = tag("title", escape(f"seed {seed}: {ended}"))
            # Successes are at the bottom, errors at the top, failures as tall as both.
            top, size = (y + 9, 13) if success else (y, 7 if broken else 22)
            shape = {"x": round(left + place * step, 1), "y": top, "width": round(max(step - 1, 1), 1), "height": size}
            parts.append(tag("rect", tip, **shape, class_="ok" if success else "bad-fill"))
    first = rows[0][1][0][0]
    height = _TOP + 30 * len(rows)
    parts.append(caption(left, height + 14, f"seed {first}", "start", "label"))
    parts.append(caption(left + count * step, height + 14, f"{first + count - 1}", "end", "label"))
    return svg(WIDTH, height + 20, parts, "Outcomes by seed")


def times(rows: Sequence[tuple[str, Sequence[tuple[int, float]]]]) -> str:
    """Plot times to success.

    Args:
        rows: label of each policy, with seed and time [s] of each success.
    """
    left = _margin(label for label, _ in rows)
    times_s = [time_s for _, successes in rows for _, time_s in successes]
    axis = Axis(0, 1.05 * max(times_s), left, WIDTH - _RIGHT)
    height = _TOP + 30 * len(rows) + _BOTTOM
    parts = grid_below(axis, _TOP, height - _BOTTOM, "time to success [s]")
    for number, (label, successes) in enumerate(rows):
        y = _TOP + 30 * number + 15
        parts.append(caption(left - 10, y + 4, label, "end"))
        for seed, time_s in successes:
            tip = tag("title", f"seed {seed}: {time_s:.2f} s")
            parts.append(tag("circle", tip, cx=axis(time_s), cy=y, r=4, class_="faint"))
    return svg(WIDTH, height, parts, "Times to success")


def map_of(points: Sequence[tuple[float, float, bool, str]], names: tuple[str, str], title: str) -> str:
    """Plot outcomes over two factors, e.g. a position, on axes of equal scale.

    Args:
        points: x, y, success and tooltip of each episode.
        names: the factors.
        title: shown above the plot.
    """
    width, height = 350, 320
    across = axis_of([x for x, _, _, _ in points], _LEFT, width - _RIGHT)
    up = axis_of([y for _, y, _, _ in points], height - _BOTTOM, _TOP + 16)
    scale = max(
        (across.high - across.low) / (width - _RIGHT - _LEFT), (up.high - up.low) / (height - _BOTTOM - _TOP - 16)
    )
    across, up = _widened(across, scale), _widened(up, scale)
    parts = _panel(across, up, names, title)
    parts += [mark(across(x), up(y), success, tip) for x, y, success, tip in points]
    return svg(width, height, parts, f"{title}: outcomes over {names[0]} and {names[1]}")


def _panel(across: Axis, up: Axis, names: tuple[str, str], title: str) -> list[str]:
    """Axes of a small plot with their names, and its title."""
    names_y = _TOP + 6
    return [
        *grid_below(across, up.end, up.begin, names[0]),
        *grid_beside(up, across.begin, across.end),
        caption(across.begin - 6, names_y, names[1], "start", "label"),
        caption(across.end, names_y, title, "end"),
    ]


def _widened(axis: Axis, scale: float) -> Axis:
    middle, half = (axis.low + axis.high) / 2, scale * abs(axis.end - axis.begin) / 2
    return attrs.evolve(axis, low=middle - half, high=middle + half)


def by_factor(points: Sequence[tuple[float, bool]], name: str, title: str) -> str:
    """Plot the success rate over a factor, in bins of equal numbers of episodes, with intervals.

    Args:
        points: value of the factor and success of each episode.
        name: the factor.
        title: shown above the plot.
    """
    width, height = 350, 190
    ordered = sorted(points)
    across = axis_of([value for value, _ in ordered], _LEFT, width - _RIGHT)
    up = Axis(0, 100, height - _BOTTOM, _TOP + 16)
    parts = _panel(across, up, (name, "successes [%]"), title)
    bins = min(_BINS, len(ordered))
    for number in range(bins):
        part = ordered[number * len(ordered) // bins : (number + 1) * len(ordered) // bins]
        successes, count = sum(success for _, success in part), len(part)
        low, high, y = part[0][0], part[-1][0], up(100 * successes / count)
        x = across((low + high) / 2)
        interval = clopper_pearson(successes, count)
        parts.append(stroke(x, up(100 * interval.low), x, up(100 * interval.high), "range"))
        parts.append(stroke(across(low), y, across(high), y, "estimate"))
        parts.append(mark(x, y, True, f"{successes} of {count}"))
    return svg(width, height, parts, f"{title}: success rate over {name}")
