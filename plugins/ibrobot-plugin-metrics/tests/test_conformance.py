"""The component of the section passes the suite of sections, and answers for the run."""

from __future__ import annotations

import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import override

import pytest
from ibrobot_metrics import ibrobot_sections
from ibrobot_metrics.component import MetricsPort
from ibrobot_metrics.options import MetricsOptions
from ibrobot_testing import SectionSuite, check_descriptor, make_session

from ibrobot_core.api import IbrobotError, SensorError
from ibrobot_core.app import Component, Session


class TestMetricsPort(SectionSuite):
    @override
    def component(self, session: Session) -> Component:
        return MetricsPort(MetricsOptions(port=0), session)


def test_descriptor_is_complete() -> None:
    (descriptor,) = ibrobot_sections()
    check_descriptor(descriptor, MetricsOptions(port=0))
    component = descriptor.make(MetricsOptions(port=9464), make_session())
    assert (component.name, component.needs) == ("metrics", ("control",))
    assert component.summary == "/metrics, /healthz and /readyz on port 9464 of this machine"


@pytest.fixture
def session() -> Session:
    return make_session()


@pytest.fixture
def port(session: Session) -> Iterator[MetricsPort]:
    made = MetricsPort(MetricsOptions(port=0), session)
    made.start()
    yield made
    made.stop()


def get(port: MetricsPort, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(port.url.replace("/metrics", path), timeout=30) as page:
            return page.status, page.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_metrics_have_the_numbers_of_now(session: Session, port: MetricsPort) -> None:
    assert 'ibrobot_episodes_total{robot="tester"} 0.0\n' in get(port, "/metrics")[1]
    session.outcome.episodes = 2
    assert 'ibrobot_episodes_total{robot="tester"} 2.0\n' in get(port, "/metrics")[1]


def test_robot_without_a_joint_state_is_healthy_and_not_ready(port: MetricsPort) -> None:
    assert get(port, "/healthz") == (200, "ok\n")
    assert get(port, "/readyz") == (503, "no joint state has been received yet\n")


def test_run_that_failed_is_unhealthy(session: Session, port: MetricsPort) -> None:
    session.fail("sensor:top", SensorError("unplugged"))
    assert get(port, "/healthz") == (503, "sensor:top: unplugged\n")


def test_run_that_is_over_is_unhealthy(session: Session, port: MetricsPort) -> None:
    session.finish()
    assert get(port, "/healthz") == (503, "the run is over\n")


def test_port_that_is_taken_is_named(session: Session, port: MetricsPort) -> None:
    number = int(port.url.split(":")[2].split("/")[0])
    second = MetricsPort(MetricsOptions(port=number), session)
    with pytest.raises(IbrobotError, match=rf"metrics: port {number} of 127\.0\.0\.1 is not available"):
        second.start()
    second.stop()
