"""The metrics of a run: what a Prometheus parser reads of them."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ibrobot_metrics.collector import Families, RunCollector
from ibrobot_testing import make_session
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from ibrobot_core.app import Session

TEXTS = st.text(st.characters(codec="utf-8"), max_size=60)
HOSTILE = 'a"} 1\nibrobot_forged{x="\\'


@given(
    st.dictionaries(TEXTS, st.floats(), min_size=1, max_size=5),
    st.booleans(),
    TEXTS.filter(lambda text: "\r" not in text),
)
def test_parser_reads_back_any_label_and_any_number(values: dict[str, float], counter: bool, about: str) -> None:
    families = Families({})
    for label, value in values.items():
        families.add("some.thing/else", value, {"robot": label}, counter=counter, about=about)
    # The format ends lines by \n alone; this parser takes any that Python knows.
    (family,) = text_string_to_metric_families(_one_kind_of_line_end(generate_latest(families).decode()))
    assert (family.name, family.type) == ("ibrobot_some_thing_else", "counter" if counter else "gauge")
    read = {sample.labels["robot"]: sample.value for sample in family.samples}
    expected = {_one_kind_of_line_end(label): value for label, value in values.items()}
    assert read.keys() == expected.keys()
    for label, value in read.items():
        assert value == expected[label] or math.isnan(value) == math.isnan(expected[label]) is True


def _one_kind_of_line_end(text: str) -> str:
    return "".join("?" if char in "\r\x0b\x0c\x1c\x1d\x1e\x85\u2028\u2029" else char for char in text)


def test_text_from_outside_adds_no_line_and_no_metric() -> None:
    families = Families({"robot": HOSTILE})
    families.add("requests", 3, counter=True, about=HOSTILE)
    text = generate_latest(families).decode()
    assert [line.split(" ")[0] for line in text.splitlines()] == ["#", "#", 'ibrobot_requests_total{robot="a\\"}']
    (family,) = text_string_to_metric_families(text)
    assert [sample.labels for sample in family.samples] == [{"robot": HOSTILE}]


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("age_ms", 1500.0, "ibrobot_age_seconds 1.5"),
        ("lateness_p50_us", 250, "ibrobot_lateness_p50_seconds 0.00025"),
        ("rate_hz", 30.5, "ibrobot_rate_hertz 30.5"),
        ("uptime_s", 3.0, "ibrobot_uptime_seconds 3.0"),
        ("alive", True, "ibrobot_alive 1.0"),
    ],
)
def test_units_are_base_units(name: str, value: float, line: str) -> None:
    families = Families({})
    families.add(name, value)
    assert generate_latest(families).decode().splitlines()[-1] == line


def test_long_label_is_cut() -> None:
    families = Families({"robot": "x" * 10_000})
    families.add("a", 1)
    assert len(generate_latest(families)) < 300


def test_groups_of_diagnostics_become_families() -> None:
    session = make_session()
    session.control.report = {
        "loop": {"ticks": 7, "lateness_p99_us": 120},
        "counters": {"joints": {"elbow_flex": 2}, "hardware": {"arm": {"retries": 1, "port": "/dev/ttyACM0"}}},
    }
    session.add_fault("the bus is silent")
    found = {family.name: family for family in text_string_to_metric_families(_text(session))}
    for name, kind, labels, value in (
        ("ibrobot_loop_ticks", "counter", {}, 7),
        ("ibrobot_loop_lateness_p99_seconds", "gauge", {}, 0.00012),
        ("ibrobot_interventions", "counter", {"joint": "elbow_flex"}, 2),
        ("ibrobot_hardware_retries", "counter", {"name": "arm"}, 1),
        ("ibrobot_faults", "counter", {}, 1),
        ("ibrobot_estop", "gauge", {}, 0),
        ("ibrobot_mode", "gauge", {"mode": "idle"}, 1),
    ):
        (sample,) = found[name].samples
        assert (found[name].type, sample.labels) == (kind, {"robot": "tester", **labels})
        assert sample.value == pytest.approx(value)
    assert not [name for name in found if "port" in name], "texts are no metrics"


def _text(session: Session) -> str:
    return generate_latest(RunCollector(session)).decode()
