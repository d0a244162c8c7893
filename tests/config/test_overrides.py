"""`--set` and `--mode`: what they reach, and that they are checked like the file."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import attrs
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ibrobot_core.config import RobotConfig, from_document
from ibrobot_core.config.overrides import apply_overrides, single_options
from ibrobot_core.config.show import dump_yaml
from ibrobot_core.config.yaml_nodes import Document, parse_yaml, scalar
from ibrobot_core.errors import ConfigError
from ibrobot_core.options import option
from ibrobot_core.plugins import Registry

Load = Callable[..., RobotConfig]


def test_overrides_reach_keys_list_items_and_new_sections(load_text: Load, base: str) -> None:
    config = load_text(
        base.replace("control: {rate_hz: 100, stop: hold}\n", ""),
        overrides=[
            "peripherals.top.fps=15",
            "peripherals.0.width=320",
            "control.rate_hz=1e2",
            "control_modes.teleop.executors=[arm_position]",
            "contract.observations.1.align.tol_ms=50",
        ],
    )

    assert config.peripherals["top"].options.fps == 15.0
    assert config.peripherals["top"].options.width == 320
    assert config.control.rate_hz == 100.0
    assert config.control_modes["teleop"].executors == ("arm_position",)
    assert config.contract.observations[1].align.tol_ms == 50.0


def test_the_last_override_of_a_key_counts(load_text: Load, base: str) -> None:
    assert load_text(base, overrides=["control.rate_hz=50", "control.rate_hz=60"]).control.rate_hz == 60.0


def test_a_fault_below_an_override_is_reported_as_the_overrides(load_text: Load, base: str) -> None:
    with pytest.raises(ConfigError) as message:
        load_text(base, overrides=["contract.observations.1.align={strategy: asof, tol_ms: soon}"])

    assert str(message.value) == (
        "--set contract.observations.1.align={strategy: asof, tol_ms: soon}: "
        "contract.observations.1.align.tol_ms: expected a number, got 'soon'"
    )


def test_mode_overrides_the_default(load_text: Load, base: str) -> None:
    assert load_text(base, mode="plan").default_control_mode == "plan"


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("control.rate_hz=abc", "control.rate_hz: expected a number, got 'abc'"),
        ("control.rate_hz=", "control.rate_hz: expected a number, got nothing"),
        ("control.rate=5", "control.rate: unknown key, did you mean 'rate_hz'?"),
        ("contrl.rate_hz=5", "contrl: unknown key, did you mean 'control'?"),
        ("peripherals.tpo.fps=15", "peripherals.tpo: the list has no such item, did you mean 'top'?"),
        ("peripherals.9.fps=15", "peripherals.9: the list has no such item; items: top, chest"),
        ("contract.actions.7.topic=/x", "contract.actions.7: the list has no such item; items: 0, 1"),
        ("robot.name.x=1", "robot.name: expected text, got a mapping"),
        ("control.stop=[hold", "control.stop: not valid YAML: expected ',' or ']', but got '<stream end>'"),
        ("control={rate_hz: 50, rate_hz: 60}", "control.rate_hz: repeated key, first given in line 1"),
        ("hardware={type: bus, prot: a, port: b}", "hardware.prot: unknown key, did you mean 'port'?"),
        (
            "control.stop=${IBROBOT_NO_SUCH}",
            "control.stop: environment variable IBROBOT_NO_SUCH is not set; set it, or give a default: "
            "${IBROBOT_NO_SUCH:value}",
        ),
    ],
)
def test_an_override_is_checked_like_the_file(load_text: Load, base: str, override: str, expected: str) -> None:
    with pytest.raises(ConfigError) as message:
        load_text(base, overrides=[override])

    assert str(message.value).splitlines()[0] == f"--set {override}: {expected}"


@attrs.frozen
class _Pair:
    low: int = option(0)
    high: int = option(1)

    def __attrs_post_init__(self) -> None:
        if self.low > self.high:
            raise ValueError("low is above high")


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["lowe=1"], "--pair lowe=1: lowe: unknown key, did you mean 'low'?"),
        (["low=2"], "pair: low is above high"),
    ],
)
def test_options_alone_are_checked_like_the_file(texts: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as message:
        single_options(_Pair, texts, "pair", "--pair")
    assert str(message.value) == said
    assert single_options(_Pair, ["high=5"], "pair") == _Pair(0, 5)


@pytest.mark.parametrize("override", ["control.rate_hz", "=5", "control.=5", "a..b=5", ""])
def test_an_ill_formed_override(load_text: Load, base: str, override: str) -> None:
    with pytest.raises(ConfigError) as message:
        load_text(base, overrides=[override])

    assert str(message.value) == f"--set {override}: expected PATH=VALUE, e.g. control.rate_hz=50"


def test_an_unknown_mode(load_text: Load, base: str) -> None:
    with pytest.raises(ConfigError) as message:
        load_text(base, mode="plam")

    assert str(message.value) == "--mode plam: default_control_mode: unknown control mode 'plam', did you mean 'plan'?"


def test_faults_of_the_file_come_before_those_of_overrides(load_text: Load, base: str) -> None:
    with pytest.raises(ConfigError) as message:
        load_text(base.replace("name: mini", "name: 5"), overrides=["control.rate_hz=x"])

    assert [problem.line for problem in message.value.problems] == [2, 0]


words = st.text(st.sampled_from("abcxyz_"), min_size=1, max_size=6)
values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(st.characters(codec="utf-8")),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(words, inner, max_size=3),
    max_leaves=8,
)


def _without_expansion(value: Any) -> bool:
    return "${" not in repr(value) and "~/" not in repr(value)


@given(st.lists(words, min_size=1, max_size=4), values.filter(_without_expansion))
def test_any_value_goes_in_and_comes_out(path: list[str], value: Any) -> None:
    document = Document({}, {}, [], "robot.yaml")

    apply_overrides(document, [f"{'.'.join(path)}={dump_yaml(value)}"])

    assert not document.problems
    assert document.get(*path) == value


def _paths(value: Any) -> list[list[str]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [path for name, item in items for path in ([str(name)], *([str(name), *rest] for rest in _paths(item)))]


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(change=st.tuples(st.integers(0, 10_000), values), sim=st.booleans())
def test_any_value_anywhere_is_taken_or_reported(
    load_text: Load, base: str, registry: Registry, change: tuple[int, Any], sim: bool
) -> None:
    choice, value = change
    paths = _paths(parse_yaml(base, "robot.yaml").root)
    override = f"{'.'.join(paths[choice % len(paths)])}={dump_yaml(value)}"

    try:
        config = load_text(base, overrides=[override], sim=sim)
    except ConfigError:
        return  # reported; any other exception fails this test
    assert from_document(config.document, source=config.source, sim=sim, registry=registry) == config


@example("\x85")
@given(values.filter(_without_expansion))
def test_yaml_text_reads_back_with_equal_types(value: Any) -> None:
    document = parse_yaml(dump_yaml({"key": value}), "robot.yaml")

    assert not document.problems
    assert repr(document.root["key"]) == repr(value)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_every_float_is_read_as_a_float(value: float) -> None:
    for text in (repr(value), f"{value:e}", f"{value:.17E}"):
        assert scalar(text) == float(text)
        assert isinstance(scalar(text), float)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001), ("1E5", 1e5), ("-.5", -0.5), ("5.", 5.0), (".inf", float("inf")), ("-.inf", float("-inf")),
        ("on", "on"), ("off", "off"), ("yes", "yes"), ("no", "no"), ("y", "y"), ("True", True), ("tRue", "tRue"),
        ("0x1F", 31), ("0o17", 15), ("017", 17), ("1_000", "1_000"), ("12:30:45", "12:30:45"),
        ("~", None), ("null", None), ("Null", None), ("none", "none"), ("+1", 1), ("1.2.3", "1.2.3"), ("e5", "e5"),
        ("=", "="), ("2001-01-01", "2001-01-01"),
    ],
)  # fmt: skip
def test_scalars_of_yaml_1_2(text: str, value: object) -> None:
    read = parse_yaml(f"key: {text}", "robot.yaml").root["key"]

    assert read == value
    assert type(read) is type(value)


@given(st.text(st.sampled_from("truefalsonyTFOY 01e.-"), max_size=6))
def test_nothing_but_true_and_false_is_a_truth_value(text: str) -> None:
    if isinstance(scalar(text), bool):
        assert text.lower() in ("true", "false")


def test_quoted_scalars_are_text() -> None:
    assert parse_yaml("a: '5'\nb: \"true\"\nc: |\n  7\n", "x").root == {"a": "5", "b": "true", "c": "7\n"}


def test_pyyaml_is_not_asked_for_scalars() -> None:
    # What the strict reader is for: PyYAML itself reads these otherwise.
    assert yaml.safe_load("a: on\nb: 1e-3") == {"a": True, "b": "1e-3"}
    assert parse_yaml("a: on\nb: 1e-3", "x").root == {"a": "on", "b": 0.001}
