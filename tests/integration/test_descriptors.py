"""The descriptor of every type that this repository offers, with its defaults."""

from __future__ import annotations

from typing import Any

import attrs
import pytest
from ibrobot_testing import check_descriptor

from ibrobot_core.api import Descriptor
from ibrobot_core.app import installed_plugins

pytestmark = pytest.mark.integration

KNOWN = installed_plugins()
TYPES = [
    pytest.param(found, id=f"{kind}-{type_}")
    for kind in KNOWN.all_kinds
    for type_ in KNOWN.types(kind)
    if isinstance(found := KNOWN.find(kind, type_), Descriptor)
    if type_ != "zenoh"  # whom to connect to has no default
    if all(field.default is not attrs.NOTHING for field in attrs.fields(found.options))
]


def test_there_are_types_of_every_kind() -> None:
    assert len(TYPES) >= 15


@pytest.mark.parametrize("descriptor", TYPES)
def test_it_is_right(descriptor: Descriptor[Any]) -> None:
    check_descriptor(descriptor, descriptor.options())
