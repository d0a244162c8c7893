"""Both engines, as the YAML describes them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, override

import attrs
import pytest
from ibrobot_serve import ibrobot_engines
from ibrobot_serve.options import DistributedOptions, ProcessOptions
from ibrobot_serve.service import InferenceService
from ibrobot_testing import EngineSuite, check_descriptor, host_context
from ibrobot_testing.fakes import FakePolicy, FakeTransport

from ibrobot_core.api import Context, Engine, EngineDescriptor, ModelContext
from ibrobot_core.app import RobotConfig, load_config

if TYPE_CHECKING:
    from ibrobot_testing.site import Site

ROBOT = """\
robot:
  name: mini
  joints: [{name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}]
  groups: {arm: [pan]}
simulation: {type: scene}
executors: {arm_position: {type: position, group: arm}}
models: {net: {type: plain}}
control_modes: {idle: {executors: [arm_position]}}
default_control_mode: idle
"""
DESCRIPTORS = {descriptor.type: descriptor for descriptor in ibrobot_engines()}


@pytest.fixture
def config(site: Site, tmp_path: Path) -> RobotConfig:
    """A robot with a fake policy that other processes can make as well."""
    site.add("net-parts", Path(__file__).with_name("inference_parts.py"))
    (tmp_path / "mini.yaml").write_text(ROBOT)
    return load_config(tmp_path / "mini.yaml", sim=True)


class TestProcess(EngineSuite):
    @pytest.fixture(autouse=True)
    def robot(self, config: RobotConfig) -> None:
        self.config = config

    @override
    def context(self) -> Context:
        ctx = host_context("net", robot=self.config.robot)
        return attrs.evolve(ctx, model=ModelContext(self.config, FakePolicy(ctx)))

    @override
    def make(self, ctx: Context) -> Engine:
        return DESCRIPTORS["process"].make(ProcessOptions(), ctx)


class TestDistributed(EngineSuite):
    @pytest.fixture(autouse=True)
    def server(self, no_leaks: None) -> Iterator[None]:
        self.transport = FakeTransport()
        service = InferenceService(FakePolicy(host_context()), self.transport, "net")
        service.start()
        yield
        service.close()
        self.transport.close()

    @override
    def context(self) -> Context:
        ctx = super().context()
        assert ctx.model is not None
        return attrs.evolve(ctx, model=attrs.evolve(ctx.model, transport=self.transport))

    @override
    def make(self, ctx: Context) -> Engine:
        return DESCRIPTORS["distributed"].make(DistributedOptions(), ctx)


@pytest.mark.parametrize("descriptor", DESCRIPTORS.values(), ids=lambda each: each.type)
def test_descriptor_is_right(descriptor: EngineDescriptor) -> None:
    check_descriptor(descriptor, descriptor.options())


def test_weights_are_on_this_machine_unless_a_server_has_them() -> None:
    needs = {type_: (each.uses_transport, each.weights_here) for type_, each in DESCRIPTORS.items()}
    assert needs == {"process": (False, True), "distributed": (True, False)}
