"""Questions of a command to the user, on standard input."""

from __future__ import annotations

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import RequestError, echo


class Declined(IbrobotError):
    """The user answered a question with no; earlier steps are not undone."""

    from_input = False

    def __init__(self) -> None:
        super().__init__("stopped: the answer was no")


def confirm(question: str, *, flag: str, default: bool = False) -> bool:
    """Ask a yes/no question; see `prompt`."""
    answer = prompt(f"{question} [{'Y/n' if default else 'y/N'}]: ", flag=flag)
    return answer.strip().lower() in (("y", "yes", "") if default else ("y", "yes"))


def prompt(question: str, *, flag: str) -> str:
    """Ask for a line, which `flag` gives on the command line.

    Raises:
        RequestError: if standard input has no answer, e.g. in a script.
    """
    echo(question, nl=False)
    try:
        return input()
    except EOFError:
        raise RequestError(f"{question} Standard input has no answer: run it in a terminal, or give {flag}") from None
