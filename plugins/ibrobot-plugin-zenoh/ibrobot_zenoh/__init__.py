"""The plugin's hooks: transport `zenoh`, its panel, commands for topics, services, actions, bags and certificates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ibrobot_core.api import DecoderDescriptor, Late, TransportDescriptor, hookimpl
from ibrobot_core.app import Command, PanelDescriptor
from ibrobot_zenoh.options import Share, ZenohOptions, check_files, server_options


@hookimpl
def ibrobot_transports() -> Iterable[TransportDescriptor]:
    """Between machines."""
    yield TransportDescriptor(
        type="zenoh",
        options=ZenohOptions,
        make=Late("ibrobot_zenoh.transport:ZenohTransport"),
        default=True,
        listen=server_options,
        components=lambda options, session, link: Late("ibrobot_zenoh.sharing:components")(
            options.share, session, link
        ),
        used=lambda options: options.share != Share(),
        check_options=check_files,
        publishes=_subscribed,
        offers=lambda options, service: options.share.offers(service),
        summary="between machines, including ROS 2 nodes with rmw_zenoh",
    )


def _subscribed(options: ZenohOptions) -> list[tuple[tuple[str | int, ...], str]]:
    """The topics of other machines, each with its key in the options."""
    topics = options.share.subscribe
    keys: Iterable[str | int] = topics if isinstance(topics, Mapping) else range(len(topics))
    return [(("share", "subscribe", key), topic) for key, topic in zip(keys, topics, strict=True)]


@hookimpl
def ibrobot_panels() -> Iterable[PanelDescriptor]:
    """The machines that a run is connected to."""
    yield PanelDescriptor(
        "Zenoh peers", ("peer", "kind", "address", "certificate"), Late("ibrobot_zenoh.panel:peer_rows")
    )


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of compressed images from ROS 2 nodes."""
    yield DecoderDescriptor(("jpeg", "png", "compressedDepth png"), Late("ibrobot_ros2.pictures:decode_picture").load)


_COMMANDS = {
    "action": "List actions on the network, and send goals to them.",
    "bag": "Play recorded episodes to machines on the network.",
    "topic": "List, show, measure and publish topics shared over the network.",
    "service": "List, show and call services shared over the network.",
    "certs": "Make certificates for a server and its robots.",
}
"""Commands, each in a module of its name."""


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Commands for topics, services, bags and certificates."""
    for name, summary in _COMMANDS.items():
        yield Command(name, summary, Late(f"ibrobot_zenoh.commands.{name}:{name}").load)
