"""One attrs object given by YAML text or overrides alone: for commands that work without a robot YAML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ibrobot_core.config.convert import Converter, Faults, error_message
from ibrobot_core.config.overrides import apply_overrides
from ibrobot_core.config.yaml_nodes import parse_yaml


def single_options[T](kind: type[T], overrides: Sequence[str], name: str, flag: str = "--set", text: str = "{}") -> T:
    """An options class, or another attrs class such as a message, checked as a section of a robot YAML.

    Args:
        kind: the class.
        overrides: `option=value` texts, e.g. `codec=h264`.
        name: what errors call the component.
        flag: which option of the command line the overrides were given by.
        text: YAML to begin with, e.g. `{data: true}`.

    Raises:
        ConfigError: with everything that is wrong.
    """
    document = parse_yaml(text, name)
    apply_overrides(document, overrides, flag)
    document.raise_problems()
    try:
        found: T = Converter(Path.cwd()).structure(document.root, kind)
    except Faults as faults:
        for key, message in faults.found:
            document.add(key, message)
    except (ValueError, TypeError) as error:  # values that do not go together
        document.add((), error_message(error))
    else:
        return found
    document.raise_problems()
    raise AssertionError("not reached: there was a fault")
