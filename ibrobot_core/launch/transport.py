"""Transport: the connection of a run to other machines."""

from __future__ import annotations

from typing import override

from ibrobot_core.component import Component
from ibrobot_core.component_config import ComponentConfig as Section
from ibrobot_core.errors import ComponentFailed
from ibrobot_core.interfaces import Transport
from ibrobot_core.launch.session import Session

NAME = "transport"


class TransportLink(Component):
    """Opens the transport named in the YAML, for components that communicate with other machines."""

    def __init__(self, session: Session, section: Section) -> None:
        super().__init__(NAME, f"transport {section.type}")
        self._session = session
        self._section = section
        self._transport: Transport | None = None

    @property
    def transport(self) -> Transport:
        """The transport.

        Raises:
            ComponentFailed: before it is open.
        """
        if self._transport is None:
            raise ComponentFailed("the transport is not open yet")
        return self._transport

    @override
    def start(self) -> None:
        self._transport = self._session.make("transport", self._section, NAME)

    @override
    def stop(self) -> None:
        if self._transport is not None:
            self._transport.close()
            self._transport = None
