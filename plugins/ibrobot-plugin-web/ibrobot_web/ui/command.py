"""`ibrobot ui`: serves a page without a running robot."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
from pathlib import Path

import attrs
from ibrobot_http.server import HttpServer
from ibrobot_provenance.processes import Jobs

from ibrobot_core.api import option
from ibrobot_core.app import LogFormatter, RequestError, echo, end_signals
from ibrobot_web.desktop import open_browser
from ibrobot_web.options import WebOptions
from ibrobot_web.server.page_guard import page_guard
from ibrobot_web.status import without_tokens
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.server import make_app


@attrs.frozen(kw_only=True)
class ServeUi:
    """Set up, launch and record robots in the browser.

    Reads and writes the files of each FOLDER, and no others; of the current folder by default. Prints the address of
    the page and one to watch only, each with its token. Ctrl-C ends the page, and every run and job that it started.
    """

    folders: tuple[Path, ...] = option((), typed="FOLDER", help="folders with files; by default this one")
    port: int = option(8090, ge=0, le=65535, help="0: any free port")
    no_browser: bool = option(False, help="do not open the page in the browser of this desktop")
    host: str = option("127.0.0.1", help="address; beyond this machine it needs TLS")
    certificate: Path | None = option(None, help="TLS certificate, with its chain")
    key: Path | None = option(None, help="private key of the certificate")
    names: tuple[str, ...] = option((), typed="--name", help="further host name of this machine in browsers")

    def __call__(self) -> None:
        for each in self.folders:
            if not each.is_dir():
                raise RequestError(f"{each}: there is no such folder")
        try:
            options = WebOptions(
                host=self.host, port=self.port, names=self.names, certificate=self.certificate, key=self.key
            )
        except ValueError as error:
            raise RequestError(str(error)) from None
        opened = Folders(self.folders or (Path(),))
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(LogFormatter("%(levelname).1s %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
        context = Ui(opened, Jobs(opened.first, without_tokens), _run_options(options))
        try:
            asyncio.run(_serve(options, context, browser=not self.no_browser))
        finally:
            context.close()


def _run_options(options: WebOptions) -> tuple[str, ...]:
    """The options of runs, whose pages are served where this one is."""
    values = {"port": 0, "browser": "false", "host": options.host}
    if options.certificate is not None and options.key is not None:
        values |= {"certificate": str(options.certificate.resolve()), "key": str(options.key.resolve())}
    if options.names:
        values["names"] = f"[{', '.join(options.names)}]"
    return ("--web", *(word for key, value in values.items() for word in ("--set", f"viewer.{key}={value}")))


async def _serve(options: WebOptions, context: Ui, *, browser: bool) -> None:
    """Serve until a signal."""
    guard = page_guard(options, any_port="--port 0")
    async with HttpServer(guard, make_app(guard, context)):
        address = guard.link("drive")
        echo(f"page: {address}  (to watch only: {guard.link('watch')})")
        sys.stdout.flush()
        if browser:
            open_browser(address)
        await _ended()


async def _ended() -> None:
    """Return at the first signal that ends a command; a second Ctrl-C ends it at once."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in end_signals():
        loop.add_signal_handler(number, ended.set)
    await ended.wait()
    for number in end_signals():
        with contextlib.suppress(ValueError):
            loop.remove_signal_handler(number)
    signal.signal(signal.SIGINT, signal.default_int_handler)
