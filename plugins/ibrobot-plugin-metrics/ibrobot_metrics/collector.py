"""Counters and measurements of a run, as metric families of Prometheus."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, override

from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from ibrobot_core.app import RunView

_NAMED_BY_KEY = {"interventions": "joint", "bus drops": "topic"}
"""Groups whose keys are names of joints or topics, which become labels."""
_GAUGES = frozenset({"plan_length", "watermark", "lateness_p50_us", "lateness_p99_us"})
"""Integers that can also decrease."""
_UNITS = {"_ms": ("_seconds", 1e-3), "_us": ("_seconds", 1e-6), "_s": ("_seconds", 1.0), "_hz": ("_hertz", 1.0)}
_LABEL_SIZE = 200
NO_LABELS: Mapping[str, str] = MappingProxyType({})


class RunCollector(Collector):
    """The groups of `/diagnostics`, each number with the label `robot`."""

    def __init__(self, session: RunView) -> None:
        self._session = session

    @override
    def collect(self) -> Iterable[Metric]:
        """The present values of all numbers of the run."""
        session = self._session
        state, outcome = session.state, session.outcome
        families = Families({"robot": session.config.robot.name})
        families.add("mode", 1, {"mode": session.mode}, about="the active mode")
        families.add("estop", state is not None and state.estop, about="whether the emergency stop is latched")
        families.add("faults", len(outcome.faults), counter=True)
        families.add("episodes", outcome.episodes, counter=True)
        families.add("successes", outcome.successes, counter=True)
        for group, values in session.counts().items():
            _add_group(families, group, values)
        return families.collect()


class Families(Collector):
    """Families of metrics, filled one value at a time.

    Args:
        labels: labels of every value.
    """

    def __init__(self, labels: Mapping[str, str]) -> None:
        self._labels = labels
        self._found: dict[str, CounterMetricFamily | GaugeMetricFamily] = {}

    def add(
        self,
        name: str,
        value: float,
        labels: Mapping[str, str] = NO_LABELS,
        *,
        counter: bool = False,
        about: str = "",
    ) -> None:
        """Add one value.

        Args:
            name: without the prefix `ibrobot_`; a unit at its end is changed to a base unit: `_ms` to `_seconds`.
            value: in the unit of the name.
            labels: further labels; the first value of a family determines their names.
            counter: whether the value only increases.
            about: help text.
        """
        for suffix, (unit, factor) in _UNITS.items():
            if name.endswith(suffix):
                name, value = name.removesuffix(suffix) + unit, value * factor
                break
        name = "ibrobot_" + re.sub(r"[^a-zA-Z0-9_]", "_", name)
        given = {**self._labels, **labels}
        if name not in self._found:
            kind = CounterMetricFamily if counter else GaugeMetricFamily
            self._found[name] = kind(name, about, labels=tuple(given))
        self._found[name].add_metric([text[:_LABEL_SIZE] for text in given.values()], float(value))

    @override
    def collect(self) -> Iterable[Metric]:
        """The families, in the order in which they were added."""
        return self._found.values()


def _add_group(families: Families, group: str, values: Mapping[str, Any]) -> None:
    """Add the numbers of a group of `/diagnostics`."""
    if (label := _NAMED_BY_KEY.get(group)) is not None:
        for name, value in values.items():
            families.add(group, value, {label: name}, counter=True)
        return
    kind, _, name = group.partition(" ")
    labels = {"name": name} if name else {}
    for key, value in values.items():
        if isinstance(value, int | float):
            counter = isinstance(value, int) and not isinstance(value, bool) and key not in _GAUGES
            families.add(f"{kind}_{key}", value, labels, counter=counter)
