"""Options of one component, given by overrides alone: for commands that run it without a robot YAML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ibrobot_core.config.convert import Faults, make_converter
from ibrobot_core.config.overrides import apply
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.errors import ConfigError


def single_options[T](kind: type[T], overrides: Sequence[str], name: str) -> T:
    """An options class filled from `option=value` texts, each checked as in a robot YAML.

    Args:
        kind: the options class.
        overrides: e.g. `codec=h264`.
        name: what errors call the component.

    Raises:
        ConfigError: with everything that is wrong.
    """
    document = Document({}, {}, [], name)
    apply(document, overrides)
    document.raise_problems()
    try:
        options: T = make_converter(Path.cwd()).structure(document.root, kind)
    except Faults as faults:
        for key, message in faults.found:
            document.add(key, message)
        document.raise_problems()
        raise ConfigError([]) from None  # not reached: there was at least one fault
    return options
