"""`ibrobot contract init`."""

from __future__ import annotations

from pathlib import Path

import attrs

from ibrobot_core.api import RecorderError, option
from ibrobot_core.app import echo, wrong_input


@attrs.frozen(kw_only=True)
class DraftContract:
    """Draft a contract for BAG from its topics and their first messages.

    The draft is a YAML file for `ibrobot convert --config`. Lines marked CHOOSE need a decision: read them all.
    """

    bag: Path = option(typed="BAG", names="episodes", help="the bag")
    output: Path | None = option(None, typed="-o", help="the new file; by default, print the contract")

    @wrong_input()
    def __call__(self) -> None:
        from ibrobot_mcap.commands.find_episodes import opened
        from ibrobot_mcap.draft import draft

        with opened(self.bag) as reader:
            text = draft(reader)
        if self.output is None:
            echo(text, nl=False)
            return
        try:
            with self.output.open("x", encoding="utf-8") as file:
                file.write(text)
        except OSError as error:
            raise RecorderError(f"{self.output}: cannot be written: {error.strerror}") from error
        echo(f"{self.output}: read it, then `ibrobot convert {self.bag} --config {self.output} --out DATASET`")
