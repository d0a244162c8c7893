"""The plugin's hooks: transport `zenoh`, its panel, commands for topics, services, actions, bags and certificates."""

from __future__ import annotations

from collections.abc import Iterable

from ibrobot_terminal import PanelDescriptor

from ibrobot_core.api import DecoderDescriptor, Late, TransportDescriptor, hookimpl
from ibrobot_core.app import Command
from ibrobot_zenoh.options import ZenohOptions, server_options


@hookimpl
def ibrobot_transports() -> Iterable[TransportDescriptor]:
    """Between machines."""
    yield TransportDescriptor(
        type="zenoh",
        options=ZenohOptions,
        make=Late("ibrobot_zenoh.transport:ZenohTransport"),
        default=True,
        listen=server_options,
        summary="between machines, including ROS 2 nodes with rmw_zenoh",
    )


@hookimpl(optionalhook=True)
def ibrobot_panels() -> Iterable[PanelDescriptor]:
    """The machines that a run is connected to."""
    yield PanelDescriptor(
        "zenoh_peers",
        label="Zenoh peers",
        summary="the machines that a run is connected to",
        columns=("peer", "kind", "address", "certificate"),
        make=Late("ibrobot_zenoh.panel:peer_rows"),
    )


@hookimpl
def ibrobot_decoders() -> Iterable[DecoderDescriptor]:
    """The decoder of compressed images from ROS 2 nodes."""
    yield DecoderDescriptor(("jpeg", "png", "compressedDepth png"), Late("ibrobot_ros2.pictures:decode_picture").load)


@hookimpl
def ibrobot_commands() -> Iterable[Command]:
    """Commands for topics, services, bags and certificates."""
    yield Command("action", summary="List actions on the network, and send goals to them.")
    yield Command("action list", Late("ibrobot_zenoh.commands.action:ListActions"))
    yield Command("action send", Late("ibrobot_zenoh.commands.action:SendGoal"))
    yield Command("action send_goal", Late("ibrobot_zenoh.commands.action:SendGoal"), hidden=True)
    yield Command("bag", summary="Play recorded episodes to machines on the network.")
    yield Command("bag play", Late("ibrobot_zenoh.commands.bag:Play"))
    yield Command("topic", summary="List, show, measure and publish topics shared over the network.")
    yield Command("topic list", Late("ibrobot_zenoh.commands.topic:ListTopics"))
    yield Command("topic echo", Late("ibrobot_zenoh.commands.topic:Echo"))
    yield Command("topic hz", Late("ibrobot_zenoh.commands.topic:Rate"))
    yield Command("topic pub", Late("ibrobot_zenoh.commands.topic:Publish"))
    yield Command("service", summary="List, show and call services shared over the network.")
    yield Command("service list", Late("ibrobot_zenoh.commands.service:ListServices"))
    yield Command("service show", Late("ibrobot_zenoh.commands.service:ShowService"))
    yield Command("service call", Late("ibrobot_zenoh.commands.service:CallService"))
    yield Command(
        "certs", Late("ibrobot_zenoh.commands.certs:MakeCertificates"), "Make certificates for a server and its robots."
    )
