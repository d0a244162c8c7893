"""Shares topics, services and actions between a run and other machines."""

from __future__ import annotations

from ibrobot_core.api import NotSupported
from ibrobot_core.app import Component, GoalRun
from ibrobot_zenoh.arrivals import Arrivals
from ibrobot_zenoh.network import Link
from ibrobot_zenoh.options import Share
from ibrobot_zenoh.ros_parameters import RosParameters
from ibrobot_zenoh.ros_sharing import RosSharing
from ibrobot_zenoh.shared_services import SharedServices
from ibrobot_zenoh.shared_topics import PublishedTopic, SubscribedTopics


def components(share: Share, session: GoalRun, link: Link) -> list[Component]:
    """The components that share the topics and services in a YAML.

    Raises:
        NotSupported: if it subscribes to topics of other machines, or serves them, in lockstep.
        MissingDependency: if it publishes topics of a sensor that cannot run on this machine.
    """
    if session.request.lockstep and share.subscribe:
        raise NotSupported("transport.share.subscribe: a lockstep run cannot receive topics of other machines")
    if session.request.lockstep and (share.services or share.parameters):
        raise NotSupported("transport.share.services: a lockstep run cannot answer other machines")
    if session.request.lockstep and share.actions:
        raise NotSupported("transport.share.actions: a lockstep run cannot take goals of other machines")
    session.refuse_absent("transport.share.publish", share.publish.__contains__)
    arrivals = Arrivals(session)
    subscribed: list[Component] = [SubscribedTopics(session, link, share.subscribe)] if share.subscribe else []
    served: list[Component] = []
    if share.services:
        served.append(SharedServices(session, link, share, arrivals))
    if share.parameters:
        served.append(RosParameters(session, link, share.offers, arrivals))
    if share.actions or share.services:
        served.append(RosSharing(session, link, share, arrivals))
    return [*(PublishedTopic(session, link, topic) for topic in share.publish), *subscribed, *served]
