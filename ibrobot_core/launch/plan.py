"""The plan of a run: its components, their dependencies and starting order; they stop in reverse order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import attrs

from ibrobot_core.component import CONTROL, Component, SourceWorker, TransportLink
from ibrobot_core.config.missing import unavailable_modes
from ibrobot_core.errors import ComponentFailed, NotSupported
from ibrobot_core.interfaces.run import CommandSource
from ibrobot_core.launch.absence import describe_absent
from ibrobot_core.launch.control import ControlComponent
from ibrobot_core.launch.episodes import EpisodeRecorder
from ibrobot_core.launch.outputs.status import Status
from ibrobot_core.launch.outputs.viewer import ViewerWorker
from ibrobot_core.launch.perception import SensorWorker
from ibrobot_core.launch.session import Session
from ibrobot_core.launch.simulation import SimulatedEpisodes
from ibrobot_core.launch.sources.policy import LoadedModel, PolicySource
from ibrobot_core.launch.sources.teleop import TeleopSource
from ibrobot_core.messages import MESSAGE_TYPES
from ibrobot_core.schema import ActionSpec, ObservationSpec, PeripheralConfig


@attrs.frozen
class ModeComponents:
    """The components that a mode adds to a run."""

    models: tuple[LoadedModel, ...]
    source: CommandSource
    policy: PolicySource | None = None
    """The source that runs the policy, if `source` is another one, which lets an operator intervene."""

    def sources(self) -> list[Component]:
        """The workers that command the robot, in starting order."""
        return [each for each in (self.policy, self.source) if isinstance(each, SourceWorker)]

    def components(self) -> list[Component]:
        """The components in starting order."""
        return [*self.models, *self.sources()]


@attrs.frozen
class LaunchPlan:
    """The components of a run in starting order."""

    components: tuple[Component, ...]
    link: TransportLink | None
    """The transport to other machines; None if nothing in the run needs one."""
    mode: ModeComponents
    """The components of the first mode, which `components` contains too."""
    episodes_worker: SimulatedEpisodes | None
    without: str
    """The sensors that this machine cannot run, and why; empty if it can run all."""
    unavailable: Mapping[str, str]
    """Mode -> why it is unavailable."""

    def facts(self) -> dict[str, Any]:
        """The plan as `--dry-run --json` prints it."""
        components = [{"name": c.name, "summary": c.summary, "needs": list(c.needs)} for c in self.components]
        return {"components": components, "without": self.without, "unavailable": dict(self.unavailable)}

    def lines(self) -> list[str]:
        """The plan as `--dry-run` prints it."""
        width = max(len(c.name) for c in self.components)
        lines = [
            f"{number:2}. {c.name:{width}}  {c.summary}" + (f"  (needs {', '.join(c.needs)})" if c.needs else "")
            for number, c in enumerate(self.components, 1)
        ]
        without = [f"without {self.without}"] if self.without else []
        return [*lines, *without, *unavailable_modes(self.unavailable), "stops in reverse order"]


def mode_components(session: Session, name: str, link: TransportLink | None, prompt: str = "") -> ModeComponents:
    """The components of a mode, without loading anything; `prompt` replaces that of the robot YAML for its policy."""
    mode = session.config.control_modes[name]
    if session.request.source is not None and name == session.config.default_control_mode:
        return ModeComponents((), session.request.source(session, mode))
    if mode.inference is not None:
        inference = attrs.evolve(mode.inference, prompt=prompt or mode.inference.prompt)
        model = LoadedModel(session, inference, link)
        needs = (CONTROL, *(f"sensor:{sensor.name}" for sensor in _sensors(session)))
        policy = PolicySource(session, mode, inference, model, needs)
        if inference.intervene is None:
            return ModeComponents((model,), policy)
        return ModeComponents((model,), session.registry.create("source", "intervene", session, mode, policy), policy)
    if mode.teleop is not None:
        return ModeComponents((), TeleopSource(session, mode))
    if mode.planner is not None:
        return ModeComponents((), session.registry.create("source", "planner", session, mode))
    return ModeComponents((), CommandSource())


def _sensors(session: Session) -> list[PeripheralConfig]:
    """The peripherals that can run on this machine."""
    absent = {sensor.name for sensor in session.absent}
    return [peripheral for name, peripheral in session.config.peripherals.items() if name not in absent]


def build_plan(session: Session) -> LaunchPlan:
    """Build the plan of a run.

    Raises:
        MissingDependency: if a component needs a sensor that cannot run on this machine.
        NotSupported: for a contract with topics that exist only in foreign bags.
    """
    config = session.config
    modes = config.control_modes.values()
    elsewhere = any(mode.inference is not None and mode.inference.uses_transport for mode in modes)
    specs: tuple[ObservationSpec | ActionSpec, ...] = (*config.contract.observations, *config.contract.actions)
    foreign = next((spec for spec in specs if spec.foreign), None)
    if foreign is not None and (config.recording is not None or any(mode.inference for mode in modes)):
        raise NotSupported(
            f"contract: {foreign.key}: {foreign.topic} is foreign, and exists only in bags: use this contract to "
            "convert bags, and one without foreign topics to run a robot"
        )
    unknown = next((spec for spec in config.contract.signals if spec.type not in MESSAGE_TYPES), None)
    if unknown is not None and config.recording is not None:
        raise NotSupported(
            f"contract.signals: {unknown.key}: {unknown.type} cannot be recorded, only read from bags; "
            f"known types: {', '.join(MESSAGE_TYPES)}"
        )
    if config.recording is not None:
        session.registry.require_episode_recorder()
    link = None
    if (transport := config.transport) is not None and (elsewhere or transport.options.used):
        link = TransportLink(session, transport)
        shared = transport.options.components(session, link)
    added = mode_components(session, session.mode, link)
    components: list[Component] = [link] if link is not None else []
    components += added.models
    components.append(ControlComponent(session, tuple(model.name for model in added.models)))
    components += [SensorWorker(session, peripheral, (CONTROL,)) for peripheral in _sensors(session)]
    components += added.sources()
    components.append(Status(session, (CONTROL,)))
    sections = [section.make(options, session) for section, options in session.registry.sections(config)]
    for recorder in sections:
        if isinstance(recorder, EpisodeRecorder):
            session.episodes = recorder.episodes
    components += sections
    if config.viewer is not None:
        components.append(ViewerWorker(session, config.viewer, (CONTROL,)))
    if link is not None:
        components += shared
        for each in (link, *shared):
            each.sends_stops = True
    simulated = None
    if session.simulates_episodes:
        simulated = SimulatedEpisodes(session, (added.components()[-1].name,))
        components.append(simulated)
    without = describe_absent(session.absent)
    return LaunchPlan(tuple(_ordered(components)), link, added, simulated, without, config.unavailable)


def _ordered(components: list[Component]) -> list[Component]:
    """The components in the given order, but each after the ones it needs."""
    remaining, ordered, started = list(components), [], set[str]()
    while remaining:
        ready = next((c for c in remaining if set(c.needs) <= started), None)
        if ready is None:
            stuck = "; ".join(f"{c.name} needs {', '.join(set(c.needs) - started)}" for c in remaining)
            raise ComponentFailed(f"components wait for one another: {stuck}")
        remaining.remove(ready)
        ordered.append(ready)
        started.add(ready.name)
    return ordered
