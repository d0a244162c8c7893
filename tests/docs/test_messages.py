"""The commands that messages of programs name exist, with their options: as those of the pages."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import attrs
import click
import pytest

from ibrobot_core.cli.main import cli

from .test_pages import OF_OTHERS, all_options, check_span

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
SOURCES = sorted([*ROOT.glob("ibrobot_core/**/*.py"), *ROOT.glob("plugins/*/*ibrobot*/**/*.py")])
FOREIGN = OF_OTHERS | {"--upgrade", "--reload", "--no-deps", "--version", "--help", "--user", "--task", "--embodiment"}
"""Options of other programs, e.g. pip, and those that each command has."""
KNOWN = tuple(cli.list_commands(click.Context(cli)))
FIRST_HOUR = {
    f"ibrobot_{name}"
    for name in ("core", "calibration", "camera", "data", "feetech", "keyboard", "lerobot", "mcap", "mujoco", "web")
}
"""Packages whose commands a beginner types."""
_CAMERA, _FEETECH, _LEROBOT, _MCAP, _WEB = (
    f"plugins/ibrobot-plugin-{name}/tests" for name in ("camera", "feetech", "lerobot", "mcap", "web")
)
REMEDIES = {
    "ibrobot camera list": f"{_CAMERA}/test_commands.py::test_list_shows_stable_ids_and_modes",
    "ibrobot camera calibrate": f"{_CAMERA}/test_calibrate.py::test_a_folder_of_pictures_gives_a_file",
    "ibrobot config copy": f"{_WEB}/test_config_copy.py::test_the_copy_has_the_same_text_except_for_the_values_given",
    "ibrobot config new": "plugins/ibrobot-plugin-mujoco/tests/test_urdf.py::"
    "test_arm_of_any_number_of_joints_starts_in_each_mode",
    "ibrobot contract init": "tests/integration/test_contract_alone.py::"
    "test_a_drafted_contract_converts_the_bag_that_it_is_from",
    "ibrobot convert": "tests/integration/test_contract_alone.py::"
    "test_a_drafted_contract_converts_the_bag_that_it_is_from",
    "ibrobot convert X --config X --out DATASET": "tests/integration/test_contract_alone.py::"
    "test_a_drafted_contract_converts_the_bag_that_it_is_from",
    "ibrobot identify --excite ROBOT": "tests/integration/test_identify.py::"
    "test_excitation_moves_each_joint_and_is_recorded",
    "ibrobot datasets merge DATASET --out NEW": f"{_LEROBOT}/test_versions.py::"
    "test_every_version_becomes_the_current_one_by_merging",
    "ibrobot datasets merge X --out X-v3": f"{_LEROBOT}/test_versions.py::"
    "test_training_on_an_older_version_names_the_command_that_copies_it",
    "ibrobot datasets pull": f"{_LEROBOT}/test_hub.py::test_push_and_pull_are_killed_and_go_on",
    "ibrobot datasets push": f"{_LEROBOT}/test_hub.py::test_push_and_pull_are_killed_and_go_on",
    "ibrobot doctor": "tests/cli/test_doctor.py::test_a_failing_check_of_a_plugin_is_reported_with_its_remedy",
    "ibrobot episodes mark": f"{_MCAP}/test_episodes.py::test_every_command_takes_the_names_that_list_prints",
    "ibrobot episodes repair": f"{_MCAP}/test_episodes.py::test_repair_makes_an_episode_whole_with_all_that_was_there",
    "ibrobot episodes repair X": f"{_MCAP}/test_owners.py::"
    "test_wherever_a_change_is_killed_nothing_is_lost_and_the_next_command_finishes_it",
    "ibrobot episodes trash X --restore X": f"{_MCAP}/test_trash.py::"
    "test_the_command_that_undoes_a_change_is_the_one_that_it_prints",
    "ibrobot episodes trim": f"{_MCAP}/test_episodes.py::test_trim_copies_a_part",
    "ibrobot feetech calibrate": f"{_FEETECH}/test_commands.py::"
    "test_an_arm_is_calibrated_in_the_dialogue_and_the_former_file_is_kept",
    "ibrobot feetech calibrate --name X": f"{_FEETECH}/test_commands.py::"
    "test_the_command_that_a_missing_calibration_names_makes_it",
    "ibrobot feetech calibrate X --name X": f"{_FEETECH}/test_commands.py::"
    "test_the_command_that_a_missing_calibration_names_makes_it",
    "ibrobot feetech check": f"{_FEETECH}/test_commands.py::test_drift_is_reported_and_written_back",
    "ibrobot feetech check X --name X --write": f"{_FEETECH}/test_commands.py::"
    "test_a_servo_that_dies_while_being_written_leaves_a_state_that_check_repairs",
    "ibrobot feetech emulate --physics X --link X": "tests/integration/test_feetech_pick.py::"
    "test_cube_lies_in_the_bin_and_only_the_emulator_says_so",
    "ibrobot feetech emulate X--link X --calibration X": "tests/integration/test_feetech_pick.py::"
    "test_cube_lies_in_the_bin_and_only_the_emulator_says_so",
    "ibrobot feetech find-port": f"{_FEETECH}/test_commands.py::"
    "test_the_port_is_found_by_pulling_its_cable_and_putting_it_back",
    "ibrobot feetech find-port --list": f"{_FEETECH}/test_commands.py::"
    "test_a_terminal_without_a_person_lists_the_ports",
    "ibrobot feetech import X --port X --yes": f"{_FEETECH}/test_commands.py::"
    "test_an_arm_whose_adapter_was_replaced_is_known_after_the_command_that_the_error_names",
    "ibrobot feetech import X --zero-at X --yes": f"{_FEETECH}/test_commands.py::"
    "test_an_arm_of_lerobot_is_imported_with_its_0_or_with_the_pose",
    "ibrobot feetech monitor": f"{_FEETECH}/test_commands.py::test_monitor_only_reads",
    "ibrobot feetech scan": f"{_FEETECH}/test_commands.py::test_scan_lists_who_answers_and_hints_where_nobody_does",
    "ibrobot feetech setup-motors --joint X": f"{_FEETECH}/test_commands.py::"
    "test_a_new_servo_is_found_at_any_rate_and_gets_its_id",
    "ibrobot feetech torque off XX": f"{_FEETECH}/test_commands.py::test_torque_of_servos_by_their_ids",
    "ibrobot launch": "tests/integration/test_launch.py::test_one_episode_in_real_time",
    "ibrobot launch --web": "tests/shared/page_run.py::page_run",  # by the tests of the page
    "ibrobot launch X --sim --mode web --web": "tests/shared/page_run.py::page_run",
    "ibrobot replay X CONFIG": "tests/integration/test_replay.py::test_joint_log_of_an_episode_is_replayed",
    "ibrobot ui FOLDER": f"{_WEB}/test_ui_path.py::test_from_a_robot_to_its_dataset_without_a_terminal",
}
"""Command that a message of these packages names -> the test that runs it; see `test_a_test_runs_each_remedy`."""
_MADE_FROM = {"tool": "ibrobot feetech"}
"""Variables that begin a command in a message -> what they are here."""


@attrs.frozen
class Text:
    """A text of a program; what it fills in is `X`."""

    file: Path
    line: int
    text: str

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line}"


def _texts(file: Path) -> Iterator[Text]:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    within = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts = [each.value if isinstance(each, ast.Constant) else _filled_in(each) for each in node.values]
            yield Text(file, node.lineno, "".join(map(str, parts)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in within:
            yield Text(file, node.lineno, node.value)


def _filled_in(value: ast.expr) -> str:
    assert isinstance(value, ast.FormattedValue)
    return _MADE_FROM.get(ast.unparse(value.value), "X")


@cache
def _is_help(file: Path) -> set[int]:
    """The lines of docstrings and of summaries and helps of commands and options, which are no messages."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            helps: list[ast.expr] = [node.value]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("option", "Descriptor", "Command")):
            helps = [*node.args, *(each.value for each in node.keywords)]
        else:
            continue
        lines |= {part.lineno for each in helps for part in ast.walk(each) if isinstance(part, ast.Constant)}
    return lines


def _may_name_commands(file: Path) -> bool:
    """Whether a text of a file may name a command: parsing all files takes seconds."""
    source = file.read_text(encoding="utf-8")
    return "ibrobot " in source or any(f"{{{name}}}" in source for name in _MADE_FROM)


TEXTS = [text for file in SOURCES if _may_name_commands(file) for text in _texts(file) if "ibrobot " in text.text]


def _commands(text: str) -> Iterator[str]:
    """The commands in a text, in backquotes or not: up to what ends the sentence or the command."""
    for match in re.finditer(r"(?<![\w./-])ibrobot ([a-z][\w-]*)(?=[\s`'\",;:.)]|$)([^`;,:()\n\"]*)", text):
        if match[1] in KNOWN:
            ends = re.split(
                r"\. | [|] |\.$|'| (?:and|or|for|of|in|is|if|has|to|with|which|by|below|from|then) ", match[2]
            )
            yield f"ibrobot {match[1]}{ends[0]}"


@pytest.mark.parametrize("text", [text for text in TEXTS if [*_commands(text.text)]], ids=str)
def test_a_command_in_a_message_exists(text: Text) -> None:
    for command in _commands(text.text):
        try:
            check_span(command)
        except AssertionError as error:
            raise AssertionError(f"{text}: {command!r}: {error}") from None


@pytest.mark.parametrize("text", [text for text in TEXTS if "ibrobot " in text.text and " --" in text.text], ids=str)
def test_an_option_beside_a_command_in_a_message_exists(text: Text) -> None:
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text.text))
    assert named - FOREIGN <= set(all_options(cli, click.Context(cli))), text


def test_no_message_tells_a_person_to_run_a_pip() -> None:
    """An environment of uv has none: `how_to_install` says what installs into the one that runs."""
    wrong = [
        f"{text}: {text.text!r}"
        for file in SOURCES
        if file != ROOT / "ibrobot_core/errors.py" and "pip" in file.read_text(encoding="utf-8")
        for helps in [_is_help(file)]
        for text in _texts(file)
        if "pip install" in text.text and text.line not in helps
    ]
    assert wrong == []


def test_a_made_up_option_and_command_are_found() -> None:
    for wrong in (
        "`ibrobot convert --robot-type`",
        "see ibrobot datasets hush PATH",
        "ibrobot launch X --simm; or not",
    ):
        (command,) = _commands(wrong)
        with pytest.raises(AssertionError):
            check_span(command)


def test_a_test_runs_each_remedy() -> None:
    """Those of the first hour. The file of the test has the command's words, or takes it from the message."""
    named = {
        command.strip()
        for text in TEXTS
        if FIRST_HOUR & set(text.file.parts) and text.line not in _is_help(text.file)
        for command in _commands(text.text)
    }
    groups = {f"ibrobot {name}" for name in KNOWN if isinstance(cli.get_command(click.Context(cli), name), click.Group)}
    assert named - groups == set(REMEDIES), "which test runs what a message tells a person to run?"
    for command, test in REMEDIES.items():
        path, _, name = test.partition("::")
        source = (ROOT / path).read_text(encoding="utf-8")
        assert f"def {name}(" in source, test
        if re.search(r"findall\(r?\"`ibrobot", source):
            continue
        words = [word for word in command.split()[1:] if re.fullmatch(r"(--)?[a-z][a-z-]+", word)]
        assert [word for word in words if word not in source] == [], f"{test} does not run `{command}`"
