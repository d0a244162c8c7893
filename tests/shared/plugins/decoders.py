"""Decoders of pictures, some of which know a picture."""

from __future__ import annotations

from typing import Any

from ibrobot_core import hookimpl
from ibrobot_core.descriptors import DecoderDescriptor

# Not images: tests only look at which decoder was asked.
NOTHING: Any = "nothing"
SOMETHING: Any = "something"


@hookimpl
def ibrobot_decoders():
    yield DecoderDescriptor(("empty",), lambda: lambda picture: NOTHING if not picture.data.size else None)
    yield DecoderDescriptor(("any", "short"), lambda: lambda picture: SOMETHING if picture.data.size < 5 else None)
