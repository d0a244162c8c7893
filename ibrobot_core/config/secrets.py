"""Secrets in a robot YAML: their keys, and the document without them, for recordings and output."""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Iterator, Mapping
from typing import Any, get_args

import attrs

from ibrobot_core.config.expand import expand
from ibrobot_core.config.yaml_nodes import Document
from ibrobot_core.convert import Key
from ibrobot_core.options import HIDDEN, fields
from ibrobot_core.safe_output import SHORTEST, redacted, remember_secret, without_credentials

_LOG = logging.getLogger("ibrobot.config")
_NAMES = re.compile(r"(?i)(.*_)?(password|passwd|passphrase|secret|token|api_?key)")
"""Keys treated as secrets in sections without an installed plugin, which would state the secret options."""


def note(document: Document, kind: type, value: Mapping[str, Any], key: Key) -> None:
    """Register the secret options of a class in the section at `key`, so that no error shows them."""
    for name, field in fields(kind).items():
        if (item := value.get(name)) is None:
            continue
        if field.metadata.get("secret"):
            document.secrets.add((*key, name))
            remember_secret(str(item))
            _hide_in_overrides(document, (*key, name), str(item))
        elif isinstance(item, Mapping):
            for member in (field.type, *get_args(field.type)):
                if isinstance(member, type) and attrs.has(member):
                    note(document, member, item, (*key, name))


def _hide_in_overrides(document: Document, key: Key, secret: str) -> None:
    """Hide a secret in the text of the override that contains it, which is the place of its faults."""
    for depth in range(1, len(key) + 1):
        place = document.places.get(key[:depth])
        if place is not None and place.line == 0:
            document.places[key[:depth]] = attrs.evolve(place, file=place.file.replace(secret, HIDDEN))


def expanded_again(document: Document) -> Document:
    """A recorded document with its `${…}` expanded from the present environment. Faults are added to it."""
    for key, text in list(_texts(document.root)):
        if "${" in text:
            try:
                _put(document.root, key, expand(text))
                document.references[key] = text
            except ValueError as error:
                document.add(key, str(error))
    return document


def public(document: Document) -> tuple[Any, dict[str, str]]:
    """The document's values without secrets, and secret -> its replacement: `${…}` or `***`."""
    root, instead = copy.deepcopy(document.root), {}
    for key, text, hidden in _secrets(document):
        remember_secret(text)
        instead[text] = document.references.get(key, hidden)
        _put(root, key, instead[text])
    return root, instead


def warn_of_secrets(document: Document) -> None:
    """Log a warning for each literal secret, which readers of the YAML see, and for each that is too short to hide."""
    for key, text, _ in _secrets(document):
        place = document.place(key)
        where = f"{document.file}:{place.line}" if place.line else redacted(place.file)
        if key not in document.references:
            warning = "a literal secret; take it from the environment, as ${NAME}"
            _LOG.warning("%s: %s: %s", where, document.dotted(key), warning)
        if len(text) < SHORTEST:
            warning = f"has fewer than {SHORTEST} characters, so it is not hidden in messages; choose a longer one"
            _LOG.warning("%s: %s: %s", where, document.dotted(key), warning)


def _secrets(document: Document) -> Iterator[tuple[Key, str, str]]:
    """Key, value and safe text of each value with a secret."""
    for key, text in _texts(document.root):
        by_name = bool(key) and isinstance(key[-1], str) and _NAMES.fullmatch(key[-1])
        hidden = HIDDEN if by_name or key in document.secrets else without_credentials(text)
        if hidden != text:
            yield key, text, hidden


def check_known(document: Document) -> None:
    """Add a fault for each secret that a recording does not contain."""
    for key in document.secrets:
        if document.get(*key) == HIDDEN:
            path = document.dotted(key)
            document.add(key, f"the recording does not contain this secret; give it by --set '{path}=${{NAME}}'")


def _texts(value: Any, key: Key = ()) -> Iterator[tuple[Key, str]]:
    if isinstance(value, str):
        yield key, value
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(item, (*key, name))
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from _texts(item, (*key, i))


def _put(root: Any, key: Key, value: Any) -> None:
    for part in key[:-1]:
        root = root[part]
    root[key[-1]] = value
