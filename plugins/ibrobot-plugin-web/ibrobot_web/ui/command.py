"""`ibrobot ui`: serves a page without a running robot."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
from pathlib import Path

import click
from ibrobot_http.server import HttpServer

from ibrobot_core.app import LogFormatter, echo, end_signals
from ibrobot_web.desktop import open_browser
from ibrobot_web.options import WebOptions
from ibrobot_web.server.page_guard import page_guard
from ibrobot_web.ui.context import Ui
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.job_runner import Jobs
from ibrobot_web.ui.server import make_app


@click.command()
@click.argument(
    "folders", nargs=-1, metavar="[FOLDER]...", type=click.Path(exists=True, file_okay=False, path_type=Path)
)
@click.option("--port", type=click.IntRange(0, 65535), default=8090, show_default=True, help="0: any free port.")
@click.option("--no-browser", is_flag=True, help="Do not open the page in the browser of this desktop.")
@click.option("--host", default="127.0.0.1", show_default=True, help="Address; beyond this machine it needs TLS.")
@click.option("--certificate", type=click.Path(path_type=Path), help="TLS certificate, with its chain.")
@click.option("--key", type=click.Path(path_type=Path), help="Private key of the certificate.")
@click.option("--name", "names", multiple=True, help="Further host name of this machine in browsers.")
def ui(
    folders: tuple[Path, ...], port: int, no_browser: bool, host: str, certificate: Path | None, key: Path | None,
    names: tuple[str, ...],
) -> None:  # fmt: skip
    """Set up, launch and record robots in the browser.

    Reads and writes the files of each FOLDER, and no others; of the current folder by default. Prints the address of
    the page and one to watch only, each with its token. Ctrl-C ends the page, and every run and job that it started.
    """
    try:
        options = WebOptions(host=host, port=port, names=names, certificate=certificate, key=key)
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    opened = Folders(folders or (Path(),))
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogFormatter("%(levelname).1s %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    context = Ui(opened, Jobs(opened.first), _run_options(options))
    try:
        asyncio.run(_serve(options, context, browser=not no_browser))
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
