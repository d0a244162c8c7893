"""Answers to questions, as lines of a pipe."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from ibrobot_eval.questions import Questions
from ibrobot_provenance.asking import Choice

from ibrobot_core.api import IbrobotError

YES = Choice(key="y", text="yes")


class Asked:
    def __init__(self) -> None:
        self.source, self._sink = os.pipe()
        self.questions = Questions(self.source)

    def send(self, line: str) -> None:
        os.write(self._sink, f"{line}\n".encode())

    def end(self) -> None:
        if self._sink >= 0:
            os.close(self._sink)
            self._sink = -1


@pytest.fixture
def asked() -> Iterator[Asked]:
    found = Asked()
    yield found
    found.end()
    os.close(found.source)


def test_the_answer_to_the_last_question_counts(asked: Asked) -> None:
    asked.questions.next("go?", [YES])
    asked.questions.next("really?", [YES])
    asked.send('{"ask": 1, "answer": "y"}')  # to the question before
    assert asked.questions.answer(0.0) is None
    asked.send('{"ask": 2, "answer": "n"}')  # no choice
    asked.send('{"ask": 2, "answer": "y"}')
    assert asked.questions.answer(1.0) == "y"


@pytest.mark.parametrize(
    "line", ["nonsense", "[]", "3", '{"ask": "x", "answer": "y"}', '{"ask": 1}', '{"ask": 1, "answer": "y", "more": 1}']
)
def test_a_line_that_is_no_answer_is_an_error(asked: Asked, line: str) -> None:
    asked.questions.next("go?")
    asked.send(line)
    with pytest.raises(IbrobotError, match="malformed"):
        asked.questions.answer(1.0)


def test_nobody_can_answer_once_the_program_has_gone(asked: Asked) -> None:
    asked.questions.next("go?")
    asked.end()
    with pytest.raises(IbrobotError, match="nobody can answer"):
        asked.questions.answer(1.0)
