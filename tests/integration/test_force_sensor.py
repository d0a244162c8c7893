"""A force sensor in the contract: what the policy saw of it is what bag and dataset of the run have, bit by bit."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from ibrobot_data.ticks import frames
from ibrobot_netft.emulator import EmulatedNetFt
from ibrobot_testing import ibrobot_command
from independent import STORE, Sample, missing, samples
from keeper_robot import keeper_robot
from mcap.reader import make_reader
from numpy.typing import NDArray
from page_run import page_run

from ibrobot_core.config import load_config
from ibrobot_core.contract.frames import FrameAssembler
from ibrobot_core.contract.specs import Contract
from ibrobot_core.errors import ConfigError
from ibrobot_core.interfaces.run import LaunchRequest
from ibrobot_core.launch.runtime import Runtime
from ibrobot_core.launch.session import Session
from ibrobot_core.plugins import installed_plugins

pytestmark = pytest.mark.integration

_RECORD_S = 0.04
"""Time between two records of the sensor [s]: policy and dataset, at other moments 50 ms apart, share most of them."""


@pytest.fixture
def device() -> Iterator[EmulatedNetFt]:
    """A sensor whose force along z grows by 1 mN with each record."""
    ended = threading.Event()

    def measure() -> None:
        count = 0
        while not ended.wait(_RECORD_S):
            count += 1
            sensor.measure((0, 0, 1000 * count, -count, 0, 0))

    with EmulatedNetFt() as sensor:
        thread = threading.Thread(target=measure)
        thread.start()
        yield sensor
        ended.set()
        thread.join()


def robot(folder: Path, device: EmulatedNetFt, policy: str = "fake", **observation: Any) -> Path:
    sensor = {
        "name": "wrist", "kind": "force", "type": "netft", "host": "localhost", "port": device.port, "silence": 60.0,
    }  # fmt: skip
    return keeper_robot(folder, policy, sensor, {"key": "observation.force", "peripheral": "wrist", **observation})


def test_a_policy_sees_forces_as_bag_and_dataset_have_them(site: Any, tmp_path: Path, device: EmulatedNetFt) -> None:
    site.add("frame-keeper", "frame_keeper.py")
    registry = installed_plugins()
    config = load_config(robot(tmp_path, device, "force_keeper"), sim=True)
    runtime = Runtime(Session(config, registry, LaunchRequest(duration_s=2.0)))
    runtime.start()
    try:
        while not runtime.wait(0.05):
            pass
    finally:
        runtime.stop()
    kept = sys.modules["frame_keeper"].KEPT
    assert len(kept) > 10
    forces = np.array([frame.values["observation.force"][2] for frame in kept])
    assert (np.diff(forces) >= 0).all()
    assert len({*forces.tolist()}) > len(kept) // 2, "frames have newer and newer forces"

    (path,) = (tmp_path / "bags/default/episodes").iterdir()
    spec = Contract.from_config(config)
    feature = spec.observations["observation.force"]
    assert feature.names == tuple(f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in ("x", "y", "z"))
    reader = registry.open_episode(path)
    messages = ((each.topic, each.message, each.received_ns) for each in reader.messages(spec.topics))
    for live, later in zip(
        kept, frames(FrameAssembler(spec), messages, [frame.stamp_ns for frame in kept]), strict=True
    ):
        for key, value in live.values.items():
            np.testing.assert_array_equal(value, later.values[key], strict=True)
    reader.close()

    out = tmp_path / "dataset"
    line = ["convert", str(path), "--out", str(out), "--outcome", "unknown", "--jobs", "1"]
    subprocess.run([*ibrobot_command(), *line], check=True, capture_output=True, timeout=120)
    rows = pq.read_table(out / "data/chunk-000/file-000.parquet")["observation.force"].combine_chunks()
    converted = rows.flatten().to_numpy().reshape(len(rows), -1)
    records = recorded_forces(path)
    topics = samples(path, spec)
    times = [each.received_ns for of_topic in topics.values() for each in of_topic]
    ticks = range(min(times), max(times) + 1, spec.step_ns)
    whole = [t_ns for t_ns, absent in zip(ticks, missing(topics, spec), strict=True) if not absent]
    seen = {in_effect(records, frame.stamp_ns): frame.values["observation.force"] for frame in kept}
    stored = {in_effect(records, t_ns): row for t_ns, row in zip(whole, converted, strict=True)}
    for values in (seen, stored):
        for number, value in values.items():
            assert (value.dtype, value.tobytes()) == (np.float32, records[number][1].tobytes())
    both = seen.keys() & stored.keys()
    assert len(both) > 5
    assert [seen[number].tobytes() for number in both] == [stored[number].tobytes() for number in both]


def recorded_forces(folder: Path) -> list[tuple[Sample, NDArray[np.float32]]]:
    """What the bag has of the sensor, read without ibrobot."""
    found = []
    with (folder / f"{folder.name}_0.mcap").open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages(topics=["/force/wrist/wrench"]):
            assert schema is not None
            decoded: Any = STORE.deserialize_cdr(message.data, schema.name)
            stamp, wrench = decoded.header.stamp, decoded.wrench
            numbers = [getattr(part, axis) for part in (wrench.force, wrench.torque) for axis in ("x", "y", "z")]
            sample = Sample(stamp.sec * 10**9 + stamp.nanosec, message.log_time)
            found.append((sample, np.array(numbers, np.float32)))
    return found


def in_effect(records: list[tuple[Sample, NDArray[np.float32]]], t_ns: int) -> int:
    """The number of the record that counts at a time [ns]: the newest by its stamp of those that have come."""
    due = [n for n, (sample, _) in enumerate(records) if max(sample.stamp_ns, sample.received_ns) <= t_ns]
    return max(due, key=lambda n: records[n][0].stamp_ns)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"select": ["wrench.farce.x"]}, r"Wrench has no field 'farce'.*did you mean 'force'"),
        ({"topic": "/wrench"}, r"comes from peripheral 'wrist'; give one or the other"),
        ({"image": {"resize": [4, 4]}}, r"needs a camera; /force/wrist/wrench carries geometry_msgs/msg/WrenchStamped"),
        ({"peripheral": "wirst"}, r"'wirst', did you mean 'wrist'"),
    ],
)
def test_what_a_contract_says_wrongly_of_a_force_sensor_is_named(
    tmp_path: Path, observation: dict[str, Any], message: str
) -> None:
    with EmulatedNetFt() as device, pytest.raises(ConfigError, match=message):
        load_config(robot(tmp_path, device, **observation), sim=True)


def test_torques_alone_are_selected(tmp_path: Path) -> None:
    with EmulatedNetFt() as device:
        config = load_config(robot(tmp_path, device, select=["wrench.torque"]), sim=True)
    assert Contract.from_config(config).observations["observation.force"].shape == (3,)
    assert math.prod(Contract.from_config(config).observations["observation.state"].shape) == 2


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_the_page_plots_what_the_sensor_measures(tmp_path: Path, device: EmulatedNetFt) -> None:
    """Forces and torques, which have other units, do not share an axis."""
    from playwright.sync_api import sync_playwright

    pictures = os.environ.get("IBROBOT_PICTURES")  # to look at them
    with page_run(str(robot(tmp_path, device)), "--sim", folder=tmp_path) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for width, height in ((1440, 900), (390, 844)):
            context = browser.new_context(
                viewport={"width": width, "height": height}, device_scale_factor=1 if pictures else 0.25
            )
            page = context.new_page()
            page.goto(address)
            plots_forces_and_torques(page)
            page.wait_for_timeout(3000 if pictures else 0)
            if pictures:
                page.screenshot(path=f"{pictures}/force-{width}.png")
            context.close()
        browser.close()


def plots_forces_and_torques(page: Any) -> None:
    page.get_by_role("button", name="Plots", exact=True).click()
    page.wait_for_selector("#plot-topic option", state="attached", timeout=60_000)
    waited = 0
    while "/force/wrist/wrench" not in (topics := page.locator("#plot-topic option").all_inner_texts()):
        page.wait_for_timeout(100)
        assert (waited := waited + 1) < 600, topics
    page.get_by_label("Topic", exact=True).select_option("/force/wrist/wrench")
    kinds = page.get_by_label("Values", exact=True)
    assert kinds.locator("option").all_inner_texts() == ["wrench.force", "wrench.torque"]
    assert [text for text in page.locator("#panel-plots .legend span").all_inner_texts() if text] == ["x", "y", "z"]
    kinds.select_option("wrench.torque")
    assert [text for text in page.locator("#panel-plots .legend span").all_inner_texts() if text] == ["x", "y", "z"]
    kinds.select_option("wrench.force")
