"""`ibrobot config import`: a config of another program becomes a robot YAML."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from uuid import uuid4

import attrs

from ibrobot_core.api import how_to_install, option
from ibrobot_core.app import (
    ConfigError,
    Problem,
    contract_alone,
    echo,
    installed_plugins,
    load_config,
    parse_yaml,
    read_document,
)
from ibrobot_import import ib_robot, lerobot, rosetta
from ibrobot_import.draft import Draft
from ibrobot_import.formats import CALIBRATION, FORMATS, IB_ROBOT, LEROBOT, ROSETTA, Format
from ibrobot_import.source import Fate, Source, Verdict

_CONVERTERS: Mapping[Format, Callable[[Source], dict[str, Any]]] = {
    IB_ROBOT: ib_robot.convert,
    ROSETTA: rosetta.convert,
    LEROBOT: lerobot.convert,
    CALIBRATION: lerobot.convert_calibration,
}

_TO_LAUNCH = (
    "To launch such a robot, copy its observations into the contract of a robot YAML (`ibrobot config copy so101 "
    "my.yaml`), whose actions name the executors"
)


@attrs.frozen
class Imported:
    """An imported file."""

    format: Format
    draft: Draft
    verdicts: list[Verdict]
    alone: bool
    """Whether it is a contract alone."""
    name: str
    types: tuple[tuple[str, str], ...] = ()
    """Kind and type of the plugins that the file needs."""

    def count(self) -> Counter[Fate]:
        """How many values were taken, changed and refused."""
        return Counter(each.fate for each in self.verdicts)


@attrs.frozen(kw_only=True)
class ImportConfig:
    """Make a robot YAML from FILE of IB-Robot, Rosetta or LeRobot.

    FILE is a robot YAML or contract of IB-Robot, a contract of Rosetta (version 2), or of LeRobot a calibration, or the
    config of a robot or a recording, as YAML or JSON. OUT is a new file, by default the robot's name in this folder.
    Comments in OUT say where each line comes from. The command lists the values that were changed, and those that have
    no counterpart, and why.
    """

    file: Path = option(typed="FILE", help="the file")
    out: Path | None = option(None, typed="OUT", help="the new file")
    contract: bool = option(False, help="import the contract of Rosetta alone, to convert its bags")

    def __call__(self) -> None:
        converted = convert_file(self.file, contract=self.contract)
        target = self.out or Path(f"{converted.name}.yaml")
        note = write(converted, self.file, target)
        count = converted.count()
        echo(
            f"{target}: from {converted.format.name}: {count[Fate.TAKEN]} values taken, {count[Fate.CHANGED]} changed, "
            f"{count[Fate.REFUSED]} without a counterpart"
        )
        for fate, title in ((Fate.CHANGED, "changed:"), (Fate.REFUSED, "without a counterpart:")):
            chosen = [each for each in converted.verdicts if each.fate is fate]
            for line in (title, *(f"  {each}" for each in chosen)) if chosen else ():
                echo(line)
        if note:
            echo(f"note: {note}")
        if converted.alone:
            echo(f"use it: `ibrobot convert BAG --config {target} --out DATASET`")
            echo(f"not for `ibrobot launch`: {_missing(target)}. {_TO_LAUNCH}")
        else:
            echo(f"try it: `ibrobot launch {target} --sim --mode web --web`")


def convert_file(path: Path, *, contract: bool = False) -> Imported:
    """Convert a file.

    Args:
        path: the file.
        contract: whether to import a contract of Rosetta alone.

    Raises:
        ConfigError: if it cannot be read, has an unknown format, or wrong values.
        CalibrationError: for a wrong calibration.
    """
    read_document(path)  # refuses what no reader takes, such as a file that is no mapping
    document = parse_yaml(path.read_text(encoding="utf-8"), str(path), expands=False)
    document.raise_problems()
    format_ = next((each for each in FORMATS if each.reads(document.root)), None)
    if format_ is None:
        known = "; ".join(each.name for each in FORMATS)
        keys = ", ".join(map(str, list(document.root)[:8])) or "none"
        problem = f"has an unknown format, with the keys {keys}. The formats are: {known}"
        raise ConfigError([Problem(path, 0, "", problem)])
    if contract and format_ is not ROSETTA:
        raise ConfigError([Problem(path, 0, "", f"is {format_.name}; --contract is for {ROSETTA.name}")])
    source = Source(document)
    sections = rosetta.convert(source, alone=True) if contract else _CONVERTERS[format_](source)
    document.raise_problems()
    verdicts = source.verdicts(format_.program)
    draft = Draft()
    draft.comment(f"Made by `ibrobot config import` from {path.name}, {format_.name}. Units are SI.")
    draft.comment("`line N: KEY` is where a line comes from; all others are marked.")
    if alone := set(sections) == {"contract"}:
        draft.comment(f"A contract alone, for `ibrobot convert --config`. {_TO_LAUNCH}.")
    refused = [each for each in verdicts if each.fate is Fate.REFUSED]
    draft.comment("Without a counterpart:" if refused else "Nothing is left out.")
    for each in refused:
        draft.comment(f"- {each}")
    for name, value in sections.items():
        if value:
            draft.add("")
            draft.block({name: value})
    if alone:
        return Imported(format_, draft, verdicts, True, path.stem)
    name = "".join(c if c.isalnum() or c in "-_" else "_" for c in str(sections["robot"]["name"].value))
    return Imported(format_, draft, verdicts, False, name, _types(sections))


def _missing(target: Path) -> str:
    """What a file lacks of a robot YAML."""
    try:
        load_config(target)
    except ConfigError as error:
        keys = [each.path for each in error.problems if each.message == "required key is missing"]
        return f"it has no {', '.join((*keys, 'hardware'))}"
    raise AssertionError(f"{target} is a robot YAML")


def _types(sections: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    hardware = sections["hardware"]
    bodies = [hardware, sections["simulation"]] if "type" in hardware else [*hardware.values(), sections["simulation"]]
    sensors = [("sensor", str(each["type"].value)) for each in sections.get("peripherals", ())]
    return (*(("hardware", str(each["type"].value)) for each in bodies), *sensors)


def write(converted: Imported, source: Path, out: Path) -> str:
    """Check the new file under another name, and write it if it passes.

    Returns:
        What could not be checked, since a plugin is not installed; empty if all was.

    Raises:
        ConfigError: if `out` exists or cannot be written, or with the lines of `source` whose values are wrong.
    """
    if os.path.lexists(out):
        raise ConfigError([Problem(out, 0, "", "exists already, and is not overwritten")])
    draft = out.with_name(f".{out.stem}.{uuid4().hex}.yaml")
    try:
        draft.write_text(converted.draft.text, encoding="utf-8")
        note = _check(converted, draft, source, out)
        draft.rename(out)
    except OSError as error:
        raise ConfigError([Problem(out, 0, "", f"cannot be written: {error.strerror}")]) from error
    finally:
        draft.unlink(missing_ok=True)
    return note


def _check(converted: Imported, draft: Path, source: Path, out: Path) -> str:
    """What could not be checked; see `write`."""
    try:
        if converted.alone:
            contract_alone(read_document(draft), out.absolute().parent)
        else:
            load_config(draft, sim=True)
            load_config(draft)
    except ConfigError as error:
        if packages := _lacking(converted):
            at_out = ConfigError(attrs.evolve(each, file=str(out)) for each in error.problems)
            return f"{at_out}; not all could be checked: {how_to_install(*packages)}, then `ibrobot config check {out}`"
        raise ConfigError(_at_the_source(each, converted.draft, source) for each in error.problems) from None
    return ""


def _lacking(converted: Imported) -> list[str]:
    """The packages of the hardware, the simulation and the recorder that are not installed."""
    registry = installed_plugins()
    lacking = [each for each in converted.types if each not in registry.entries]
    return [package for kind, type_ in lacking if (package := registry.official(kind).get(type_)) is not None]


def _at_the_source(problem: Problem, draft: Draft, source: Path) -> Problem:
    """A fault of the new file at the line of the old one that it comes from."""
    line = draft.origins[problem.line - 1] if 0 < problem.line <= len(draft.origins) else 0
    return Problem(source, line, problem.path, problem.message)
