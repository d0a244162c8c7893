"""The guard of the pages: sessions that drive the robot, and sessions that only watch it."""

from __future__ import annotations

from ibrobot_http.addresses import host_names
from ibrobot_http.guard import Guard
from ibrobot_http.listener import listen, tls_context

from ibrobot_web.options import WebOptions


def page_guard(options: WebOptions, *, of: str = "", any_port: str) -> Guard:
    """Open the port of a page.

    Args:
        options: where the page is served.
        of: begins the errors, e.g. `viewer: `.
        any_port: the option that chooses any free port, for an error.

    Raises:
        IbrobotError: if the port or the certificate cannot be used.
    """
    tls = None
    if options.certificate is not None and options.key is not None:
        tls = tls_context(options.certificate, options.key, of=of)
    names = host_names(options.host, options.names)
    listener = listen(options.host, options.port, names, tls=tls, of=of, any_port=any_port)
    return Guard(listener, roles=("drive", "watch"), password=options.password, strict_transport=True)
