"""What no robot YAML holds is refused by one clear error before it takes time and memory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ibrobot_core.config import RobotConfig, load_config, yaml_nodes
from ibrobot_core.config.show import to_yaml
from ibrobot_core.config.yaml_nodes import parse_yaml
from ibrobot_core.errors import ConfigError

TOO_MANY = "more than 10000 values, including those repeated by aliases"
TOO_DEEP = "nested more than 50 levels deep"
TOO_LONG = "too long: a robot YAML has at most 256 kB"


def aliases(levels: int, each: int) -> str:
    """A bomb: every level repeats the one before `each` times."""
    lines = [f"x0: &x0 [{', '.join('1' * each)}]"]
    for level in range(1, levels + 1):
        repeated = ", ".join([f"*x{level - 1}"] * each)
        lines.append(f"x{level}: &x{level} [{repeated}]")
    return "\n".join(lines)


def merges(keys: int, times: int) -> str:
    """A mapping merged into another many times over."""
    merged = ", ".join(["*a"] * times)
    return f"a: &a {{{', '.join(f'k{i}: 1' for i in range(keys))}}}\nb: {{<<: [{merged}]}}"


CASES = {
    "aliases": (aliases(10, 10), f"robot.yaml:1: {TOO_MANY}"),
    "merges": (merges(500, 4_000), f"robot.yaml:1: {TOO_MANY}"),
    "values": ("joints:\n" + "- {name: a, lower: 1}\n" * 2_500, f"robot.yaml:2001: {TOO_MANY}"),
    "unknown_keys": ("".join(f"key{i}: 1\n" for i in range(400_000)), f"robot.yaml: {TOO_LONG}"),
    "lists": ("x: " + "[" * 50_000, f"robot.yaml:1: {TOO_DEEP}"),
    "mappings": ("x: " + "{a: " * 10_000, f"robot.yaml:1: {TOO_DEEP}"),
    "items": ("- " * 3_000, f"robot.yaml:1: {TOO_DEEP}"),
    "keys": ("".join(" " * i + "a:\n" for i in range(60)), f"robot.yaml:52: {TOO_DEEP}"),
}


@pytest.mark.parametrize("case", CASES)
def test_document_is_refused(case: str) -> None:
    text, expected = CASES[case]

    with pytest.raises(ConfigError) as refused:
        parse_yaml(text, "robot.yaml")

    assert str(refused.value) == expected


def test_endless_file_is_read_to_the_limit_only() -> None:
    with pytest.raises(ConfigError, match=TOO_LONG):
        load_config("/dev/zero")


@pytest.mark.parametrize(
    ("number", "message"),
    [
        ("1" * 5_000, "a number of 5000 characters; the maximum is 40"),
        ("-" + "1" * 5_000, "a number of 5001 characters; the maximum is 40"),
        ("0x" + "f" * 5_000, "a number of 5002 characters; the maximum is 40"),
        ("1e999", "1e999 is too large for a number"),
    ],
    ids=["decimal", "negative", "hexadecimal", "exponent"],
)
def test_number_beyond_reading_is_one_fault(
    number: str, message: str, faults_of_edit: Callable[[str, str], str]
) -> None:
    assert faults_of_edit("rate_hz: 30", f"rate_hz: {number}") == f"robot.yaml:33: contract.rate_hz: {message}"


def test_long_value_is_cut_in_a_message(faults_of_edit: Callable[[str, str], str]) -> None:
    message = faults_of_edit("rate_hz: 30", f"rate_hz: {'x' * 5_000}")

    assert message.startswith("robot.yaml:33: contract.rate_hz: expected a number, got 'xxx")
    assert message.endswith("xxx… (5002 characters)")
    assert len(message) < 400


def test_many_faults_are_listed_up_to_a_screen(faults_of_edit: Callable[[str, str], str]) -> None:
    unknown = "\n".join(f"more{i}: 1" for i in range(70))

    lines = faults_of_edit("control: {rate_hz: 100, stop: hold}", unknown).splitlines()

    assert len(lines) == 51
    assert lines[-1] == "and 20 more"


def test_text_of_many_digits_is_shown_as_text(base: str, load_text: Callable[..., RobotConfig]) -> None:
    digits = "1" * 5_000

    shown = to_yaml(load_text(base.replace("/dev/null", f"'{digits}'")))

    assert f"port: '{digits}'" in shown
    assert load_text(shown).hardware["hardware"].options.port == digits


LINES = Path("configs/so101.yaml").read_text(encoding="utf-8").splitlines(keepends=True)
MARKS = [
    *":#-[]{}&*!|>'\"%@`,?<~\\ \t\n\r\x85\u2028\ufeffé",
    "---\n",
    "- ",
    "<<: ",
    "&a ",
    "*a",
    "|2\n  x\n",
    "%YAML 1.3\n",
]
PIECES = st.sampled_from(MARKS)


@given(st.integers(0, len(LINES)), st.lists(st.tuples(st.integers(0, 400), st.integers(0, 5), PIECES), max_size=4))
def test_libyaml_reads_what_pyyaml_reads(first: int, changes: list[tuple[int, int, str]]) -> None:
    text = "".join(LINES[first : first + 8])
    for at, dropped, added in changes:
        text = text[:at] + added + text[at + dropped :]

    def read() -> object:
        try:
            return repr(parse_yaml(text, "robot.yaml"))
        except ConfigError as error:
            return str(error)

    fast = read()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(yaml_nodes, "_FastLoader", yaml_nodes._Loader)
        assert fast == read()
