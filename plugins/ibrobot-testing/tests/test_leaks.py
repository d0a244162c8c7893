"""Every suite fails a plugin that leaves something behind, unless its author gives a reason."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import ibrobot_testing
import pytest
from ibrobot_testing import LeakCheck, SensorSuite, Suite, failed_checks
from ibrobot_testing.fakes import FakeSensor

from ibrobot_core.api import Context

CHECK = "test_refuses_reading_while_closed"
"""A check that opens its sensor."""
LEAKING = Path(__file__).with_name("leaking.py")
SUITES = [vars(ibrobot_testing)[name] for name in ibrobot_testing.__all__ if name.endswith("Suite")]


@pytest.fixture(scope="module")
def complaints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Suite in `leaking.py` -> what pytest says of it; empty where it passed."""
    report = tmp_path_factory.mktemp("report") / "report.xml"
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", "/dev/null")
    subprocess.run((*command, f"--junitxml={report}", "-k", CHECK, str(LEAKING)), check=False, capture_output=True)
    cases = ElementTree.parse(report).iter("testcase")
    return {
        case.attrib["classname"].rpartition(".Test")[2]: "".join(entry.attrib["message"] for entry in case)
        for case in cases
    }


@pytest.mark.parametrize(
    ("suite", "complaint"),
    [
        ("Thread", r"the test left behind: thread 'grabber'"),
        ("Process", r"the test left behind: process \d+: .* -c print\(flush=True\); input\(\)"),
        ("File", r"the test left behind: open file \d+: /\S+"),
        ("Port", r"the test left behind: port \d+ on 127\.0\.0\.1"),
    ],
)
def test_a_plugin_that_leaks_fails(complaints: dict[str, str], suite: str, complaint: str) -> None:
    assert re.search(complaint, complaints[suite])


@pytest.mark.parametrize("suite", ["AllowedThread", "AllowedPort"])
def test_a_leak_with_a_reason_is_allowed(complaints: dict[str, str], suite: str) -> None:
    assert complaints[suite] == ""


def test_every_suite_checks_for_leaks() -> None:
    assert all(issubclass(suite, Suite) for suite in SUITES)
    own = [suite for suite in SUITES if suite is not Suite and {"no_leaks", "leak_check"} & vars(suite).keys()]
    assert own == []


def test_checks_without_pytest_find_leaks(tmp_path: Path) -> None:
    files = []

    class LeavesAFile(FakeSensor):
        def open(self) -> None:
            super().open()
            files.append((tmp_path / "left").open("w"))

    class LeakingSuite(SensorSuite):
        leak_check = LeakCheck(grace_s=0.0)

        def make(self, ctx: Context) -> LeavesAFile:
            return LeavesAFile(ctx)

    assert CHECK.removeprefix("test_") in failed_checks(LeakingSuite, tmp_path)
    for file in files:
        file.close()


def test_an_exception_needs_a_reason() -> None:
    with pytest.raises(ValueError, match="say why a thread may be left behind"):
        LeakCheck(allow={"thread": " "})


def test_an_exception_names_a_kind_of_leak() -> None:
    with pytest.raises(ValueError, match="'threads' is not a kind of leak; the kinds are thread, process, file, port"):
        LeakCheck(allow={"threads": "the driver keeps them"})  # type: ignore[dict-item]
