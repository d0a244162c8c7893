"""The panel of peers: the other sides of the connections of this process."""

from __future__ import annotations

import zenoh

from ibrobot_core.api import TransportError
from ibrobot_core.app import RunView
from ibrobot_zenoh.connection import Connection, open_connections


def peer_rows(session: RunView) -> list[tuple[str, ...]]:
    """One row for each peer. A connection without peers has one row, with its addresses or why it is not connected."""
    return [row for connection in open_connections() for row in _rows(connection)]


def _rows(connection: Connection) -> list[tuple[str, ...]]:
    try:
        opened = connection.open_session
        if opened is None:
            return [("none", "", connection.why_not, "")]
        kinds = {str(each.zid): str(each.whatami) for each in opened.info.transports()}
        links = [(str(each.zid), str(each.dst), each.auth_identifier or "") for each in opened.info.links()]
    except (TransportError, zenoh.ZError):  # closed meanwhile
        return []
    rows: list[tuple[str, ...]] = [(zid[:8], kinds.get(zid, ""), address, name) for zid, address, name in links]
    return rows or [("none", "", f"waits at {connection.endpoints}", "")]
