"""The transport passes the suite between a client and a router."""

from __future__ import annotations

from typing import override

from ibrobot_testing import TransportSuite

from ibrobot_core.api import Context, Transport

from .pair import client, free_endpoint, router, settle


class TestClientAsksRouter(TransportSuite):
    @override
    def make_pair(self, ctx: Context) -> tuple[Transport, Transport]:
        endpoint = free_endpoint()
        far = router(endpoint)
        return client(endpoint), far

    @override
    def settle(self, near: Transport, far: Transport) -> None:
        settle(near, far)


class TestRouterAsksClient(TestClientAsksRouter):
    """The same with the client as the server."""

    @override
    def make_pair(self, ctx: Context) -> tuple[Transport, Transport]:
        near, far = super().make_pair(ctx)
        return far, near


class TestWithinOneTransport(TestClientAsksRouter):
    """Both ends are one object."""

    @override
    def make_pair(self, ctx: Context) -> tuple[Transport, Transport]:
        both = router(free_endpoint())
        return both, both
