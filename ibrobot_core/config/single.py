"""One attrs object given by YAML text or overrides alone: for commands that work without a robot YAML."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ibrobot_core.config.convert import Converter, Faults, error_message
from ibrobot_core.config.overrides import apply_overrides
from ibrobot_core.config.yaml_nodes import Document, parse_yaml


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
    return _structured(document, kind)


def from_yaml[T](text: str, kind: type[T], name: str) -> T:
    """An attrs class, e.g. a message, filled from YAML text and checked as a section of a robot YAML.

    Args:
        text: e.g. `{data: true}`.
        kind: the class.
        name: what errors call the text.

    Raises:
        ConfigError: with everything that is wrong.
    """
    return _structured(parse_yaml(text, name), kind)


def _structured[T](document: Document, kind: type[T]) -> T:
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
