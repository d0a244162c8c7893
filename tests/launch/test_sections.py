"""Components of sections that plugins add: when they run, and what they share with the run."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from ibrobot_core.bus import Subscription
from ibrobot_core.errors import TransportError
from ibrobot_core.messages import Int32, String

if TYPE_CHECKING:
    from fake_runs import Runs
    from ibrobot_testing.site import Site

    from ibrobot_core.launch.runtime import Runtime


@pytest.fixture(autouse=True)
def sections(site: Site) -> None:
    site.add("fake-sections", "added_sections.py")


def names(runtime: Runtime) -> list[str]:
    return [component.name for component in runtime.plan.components]


def test_a_component_runs_where_the_file_has_its_section(runs: Runs) -> None:
    assert "counter" not in names(runs.make())
    runtime = runs.make("counter.topic=/ticks")
    assert "joint states, counted on /ticks  (needs control)" in "\n".join(runtime.plan.lines())


def numbers(subscription: Subscription) -> list[int]:
    """The numbers in all waiting messages."""
    messages = [received.message for received in subscription.drain()]
    return [message.data for message in messages if isinstance(message, Int32)]


def test_a_component_shares_the_bus_and_its_services_with_the_run(runs: Runs) -> None:
    runtime = runs.start("counter.topic=/ticks", mode="teleop")
    ticks = runtime.session.bus.subscribe("/ticks", 100)
    for _ in range(3):
        runtime.step()
    counted = numbers(ticks)
    assert counted == list(range(counted[0], counted[0] + 3))
    assert runtime.session.bus.call("/reset_count", None) == "counting from 0"
    runtime.step()
    assert numbers(ticks) == [1]
    runtime.stop()
    with pytest.raises(TransportError, match="nobody serves /reset_count"):
        runtime.session.bus.call("/reset_count", None)
    ticks.close()


@pytest.mark.parametrize(
    ("overrides", "greeting"), [((), "hi"), (("greeter={}",), "hello"), (("greeter.word=hey",), "hey")]
)
def test_a_component_may_run_without_its_section(runs: Runs, overrides: tuple[str, ...], greeting: str) -> None:
    runtime = runs.start(*overrides, mode="teleop")
    assert runtime.session.bus.latched()["/greeting"].message == String(greeting)


def test_a_plugin_decides_which_robots_have_a_component_without_the_section(runs: Runs) -> None:
    assert "greeter" not in names(runs.make("robot.robot_type=deaf"))
    assert "greeter" in names(runs.make("robot.robot_type=deaf", "greeter={}"))
