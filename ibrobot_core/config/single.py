"""Options of one component, given by overrides alone: for commands that run it without a robot YAML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ibrobot_core.config.convert import Converter, Faults, error_message
from ibrobot_core.config.overrides import apply_overrides
from ibrobot_core.config.yaml_nodes import Document


def single_options[T](kind: type[T], overrides: Sequence[str], name: str, flag: str = "--set") -> T:
    """An options class filled from `option=value` texts, each checked as in a robot YAML.

    Args:
        kind: the options class.
        overrides: e.g. `codec=h264`.
        name: what errors call the component.
        flag: which option of the command line the texts were given by.

    Raises:
        ConfigError: with everything that is wrong.
    """
    document = Document({}, {}, [], name)
    apply_overrides(document, overrides, flag)
    document.raise_problems()
    try:
        options: T = Converter(Path.cwd()).structure(document.root, kind)
    except Faults as faults:
        for key, message in faults.found:
            document.add(key, message)
    except (ValueError, TypeError) as error:  # options that do not go together
        document.add((), error_message(error))
    else:
        return options
    document.raise_problems()
    raise AssertionError("not reached: there was a fault")
