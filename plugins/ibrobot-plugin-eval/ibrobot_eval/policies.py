"""Policies of an evaluation: robot YAML, mode and model, and hashes of their files."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import attrs

from ibrobot_core.api import Contract
from ibrobot_core.app import (
    ConfigError,
    Problem,
    Registry,
    RequestError,
    RobotConfig,
    find_config,
    installed_plugins,
    load_config,
)

_MOST_VALUES = 1000


@attrs.frozen
class Variation:
    """A key of the robot YAML that varies over the episodes."""

    key: str
    values: tuple[float, ...]

    @classmethod
    def of(cls, text: str) -> Variation:
        """Parse e.g. `simulation.scene.light=0.2:1.5:5`: five values from 0.2 to 1.5.

        Raises:
            RequestError: for another text.
        """
        key, _, ends = text.partition("=")
        try:
            low, high, count = ends.split(":")
            first, last, number = float(low), float(high), int(count)
        except ValueError:
            raise RequestError(f"--vary {text}: expected PATH=LOW:HIGH:COUNT, e.g. control.rate_hz=50:200:4") from None
        if not key or not first < last < float("inf") or not 2 <= number <= _MOST_VALUES:
            raise RequestError(f"--vary {text}: LOW must be below HIGH, and COUNT from 2 to {_MOST_VALUES}")
        step = (last - first) / (number - 1)
        return cls(key, tuple(round(first + step * i, 9) for i in range(number)))


def as_texts(values: Iterable[str]) -> tuple[str, ...]:
    """Texts as a tuple, e.g. from a JSON list."""
    return tuple(values)


@attrs.frozen
class Policy:
    """A policy to evaluate: a mode of a robot with a model."""

    label: str
    """Its name in the report, unique in the evaluation."""
    config: str
    """The robot YAML, as the user names it."""
    mode: str
    model: str
    """The name of the model that the mode uses."""
    overrides: tuple[str, ...] = attrs.field(converter=as_texts)
    """Overrides of the YAML, including that of the model."""
    sim: bool = True
    """Whether it runs in simulation."""
    vary: tuple[str, ...] = attrs.field(default=(), converter=as_texts)
    """Keys of the YAML that vary over the seeds; see `Variation.of`."""

    @property
    def folder(self) -> str:
        """Name of the policy's folders."""
        return re.sub(r"[^\w.,=+-]+", "_", self.label)

    def varied(self, seed: int) -> dict[str, float]:
        """Key -> its value in the episode of a seed. Consecutive seeds go through all combinations."""
        varied = {}
        for text in self.vary:
            variation = Variation.of(text)
            seed, place = divmod(seed, len(variation.values))
            varied[variation.key] = variation.values[place]
        return varied

    def varied_names(self, seed: int) -> dict[str, float]:
        """Last part of each varied key -> its value in the episode of a seed, for the factors of a result."""
        return {key.rpartition(".")[2]: value for key, value in self.varied(seed).items()}

    def overrides_of(self, seed: int | None) -> tuple[str, ...]:
        """Overrides for the episode of a seed; None for those common to all episodes."""
        varied = self.varied(seed) if seed is not None else {}
        return (*self.overrides, *(f"{key}={value!r}" for key, value in varied.items()))

    def load(self, seed: int | None = None) -> RobotConfig:
        """Load the robot of an episode. It records, as with `ibrobot record`.

        Args:
            seed: seed of the episode; None for the YAML without varied keys.

        Raises:
            ConfigError: for faults of the YAML.
        """
        registry = installed_plugins()
        path = find_config(self.config, registry)
        overrides = self.overrides_of(seed)
        plain = load_config(path, overrides=overrides, mode=self.mode, sim=self.sim, registry=registry)
        if plain.recording is not None:
            return plain
        made = f"recording={{type: {registry.default('recorder')}, root: episodes, topics: contract}}"
        return load_config(path, overrides=(made, *overrides), mode=self.mode, sim=self.sim, registry=registry)

    def command(self, seed: int) -> str:
        """The command that repeats an episode in simulation."""
        sets = (word for override in self.overrides_of(seed) for word in ("--set", override))
        options = ("--sim", "--lockstep", "--headless", "--mode", self.mode, "--seed", str(seed), "--episodes", "1")
        return shlex.join(["ibrobot", "record", self.config, *options, *sets])


@attrs.frozen
class Identity:
    """Hashes of what a policy's results depend on besides the seed."""

    document: str
    """Hash of the robot YAML with its overrides."""
    contract: str
    policy: str
    """The policy's own fingerprint."""
    files: str
    """Hash of the files named by the model's options and the robot's description; empty if there are none."""


def find_policies(
    configs: Sequence[str], modes: Sequence[str], models: Sequence[str], overrides: Sequence[str],
    vary: Sequence[str] = (), *, sim: bool,
) -> list[Policy]:  # fmt: skip
    """Find the policies of a command line: each robot YAML in each mode with each model.

    Raises:
        ConfigError: for faults of a YAML, a mode without a model, an unknown model, or policies that are the same.
    """
    policies = []
    for config, mode, model in itertools.product(configs, modes or (None,), models or (None,)):
        registry = installed_plugins()
        path = find_config(config, registry)
        robot = load_config(path, overrides=overrides, mode=mode, sim=sim, registry=registry)
        chosen = robot.control_modes[robot.default_control_mode]
        if chosen.inference is None:
            raise _fault(path, f"control_modes.{chosen.name}", "has no inference; only policies can be evaluated")
        if model is not None and model not in robot.models:
            raise _fault(path, "models", f"has no model {model!r}; the models are: {', '.join(robot.models)}")
        made = () if model is None else (f"control_modes.{chosen.name}.inference.model={model}",)
        named = model or chosen.inference.model
        policy = Policy("", config, chosen.name, named, (*overrides, *made), sim, vary)
        for seed in range(max((len(Variation.of(text).values) for text in vary), default=0)):
            load_config(path, overrides=policy.overrides_of(seed), mode=mode, sim=sim, registry=registry)
        if policy in policies:
            raise _fault(path, f"control_modes.{chosen.name}", "is given twice")
        policies.append(policy)
    return labelled(policies)


def _fault(path: Path, key: str, message: str) -> ConfigError:
    return ConfigError([Problem(path, 0, key, message)])


def labelled(policies: Sequence[Policy]) -> list[Policy]:
    """Label policies by as few of mode, robot YAML and model as distinguish them."""
    names = [(each.mode, Path(each.config).stem, each.model) for each in policies]
    parts = [chosen for size in (1, 2, 3) for chosen in itertools.combinations(range(3), size)]
    labels = [[" ".join(each[part] for part in chosen) for each in names] for chosen in parts]
    telling = next((each for each in labels if len(set(each)) == len(policies)), labels[-1])
    made: dict[str, Policy] = {}
    for policy, label in zip(policies, telling, strict=True):
        tries = (label if number == 1 else f"{label} {number}" for number in itertools.count(1))
        named = next(each for text in tries if (each := attrs.evolve(policy, label=text)).folder not in made)
        made[named.folder] = named
    return list(made.values())


def identify(policy: Policy, registry: Registry) -> Identity:
    """Identify the files of a policy, without loading its weights.

    Raises:
        IbrobotError: e.g. for a checkpoint that is missing.
    """
    robot = policy.load()
    model = robot.models[policy.model]
    made = registry.build_policy(robot, policy.model)
    described = robot.robot.description
    named = [each for each in (described.mjcf, described.urdf) if each is not None]
    named += [Path(value) for value in _leaves(attrs.asdict(model.options)) if isinstance(value, str | Path) and value]
    return Identity(
        document_hash(robot), Contract.from_config(robot).fingerprint(), made.fingerprint(), hash_of_files(named)
    )


def document_hash(robot: RobotConfig) -> str:
    """Hash of a robot YAML with its overrides."""
    return hashlib.sha256(json.dumps(robot.document, default=str).encode()).hexdigest()


def _leaves(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list | tuple):
        yield value
        return
    for each in value:
        yield from _leaves(each)


def hash_of_files(named: Sequence[Path]) -> str:
    """Hash of the content of files, and of all files in folders; those that do not exist are left out."""
    digest = hashlib.sha256()
    has_files = False
    for top in named:
        files = sorted(path for path in top.rglob("*") if path.is_file()) if top.is_dir() else [top]
        for path in files:
            if path.is_file():
                has_files = True
                digest.update(f"{path.relative_to(top)}\n".encode())
                with path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest() if has_files else ""
