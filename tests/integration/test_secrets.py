"""Nothing that a run with secrets writes or prints holds one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

pytestmark = pytest.mark.integration

ROOT = Path(__file__).parents[2]
SECRETS = {"IBROBOT_PASSWORD": "hunter2hunter2", "CAMERA_PASSWORD": "s3cretl3ns"}
LITERAL = "written-out-literal"


class Lab:
    """A folder with a robot YAML; keeps what every command printed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.printed: dict[str, str] = {}
        self.yaml = folder / "lab.yaml"
        document = yaml.safe_load((ROOT / "configs/so101_blind.yaml").read_text(encoding="utf-8"))
        document["transport"] = {
            "type": "zenoh",
            "connect": ["tcp/127.0.0.1:9"],
            "user": "robot1",
            "password": "${IBROBOT_PASSWORD}",
            "share": {"publish": ["/joint_states"]},
        }
        self.yaml.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
        self.camera = folder / "camera.yaml"
        document["hardware"] = {"type": "jointlog_none"}
        document["peripherals"] = [
            {"name": "door", "kind": "camera", "type": "opencv", "device": "rtsp://me:${CAMERA_PASSWORD}@127.0.0.1:9/x"}
        ]
        self.camera.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")

    def run(self, *arguments: object, ok: bool = True) -> str:
        words = [str(argument) for argument in arguments]
        done = subprocess.run(
            [sys.executable, "-c", "from ibrobot_core.cli.main import main; main()", *words],
            cwd=self.folder,
            env={**os.environ, **SECRETS},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        self.printed[" ".join(words)] = done.stdout + done.stderr
        assert (done.returncode == 0) == ok, done.stderr[-2000:]
        return done.stdout

    def leaks(self) -> list[str]:
        """Where a secret is, of all that was written and printed."""
        texts = {name: text.encode() for name, text in self.printed.items()}
        texts |= {str(path): path.read_bytes() for path in self.folder.rglob("*") if path.is_file()}
        secrets = [*SECRETS.values(), LITERAL]
        # A secret typed on a command line is visible on the machine; the command must not repeat it.
        return [f"{name}: {each}" for name, text in texts.items() for each in secrets if each.encode() in text]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


def test_a_recorded_run_and_its_dataset_hold_no_secret(lab: Lab):
    shared = ("--sim", "--lockstep", "--headless", "--episodes", "1", "--duration", "20")
    lab.run("record", lab.yaml, *shared, "--root", lab.folder / "episodes")
    (bag,) = (path.parent for path in (lab.folder / "episodes").rglob("metadata.yaml"))
    assert "${IBROBOT_PASSWORD}" in (bag / "metadata.yaml").read_text(encoding="utf-8")
    lab.run("convert", bag, "--out", lab.folder / "dataset")
    lab.run("episodes", "info", bag, "--json")
    lab.run("launch", lab.yaml, *shared, "--dry-run")
    assert lab.leaks() == []


def test_what_is_shown_holds_the_reference_and_loads_again(lab: Lab):
    shown = lab.run("config", "show", lab.yaml, "--sim")
    assert yaml.safe_load(shown)["transport"]["password"] == "${IBROBOT_PASSWORD}"
    (lab.folder / "shown.yaml").write_text(shown, encoding="utf-8")
    assert lab.run("config", "show", lab.folder / "shown.yaml", "--sim") == shown
    assert lab.leaks() == []


def test_a_secret_that_is_written_out_is_hidden_and_warned_of(lab: Lab):
    literal = lab.folder.parent / "literal.yaml"
    literal.write_text(lab.yaml.read_text(encoding="utf-8").replace("${IBROBOT_PASSWORD}", LITERAL), encoding="utf-8")
    shown = lab.run("config", "show", literal, "--sim")
    assert yaml.safe_load(shown)["transport"]["password"] == "***"
    (output,) = (text for command, text in lab.printed.items() if str(literal) in command)
    assert "transport.password: a literal secret" in output
    assert lab.leaks() == []


def test_a_short_secret_is_warned_of_and_leaves_other_texts_alone(lab: Lab):
    lab.run("config", "check", lab.yaml, "--sim", "--set", f"transport.password={lab.yaml.stem[:6]}")
    output = lab.printed.popitem()[1]
    assert (
        "transport.password: has fewer than 8 characters, so it is not hidden in messages; choose a longer one"
        in output
    )
    assert f"{lab.yaml}: ok" in output


def test_errors_hold_no_secret(lab: Lab):
    lab.run("config", "check", lab.camera, ok=False)
    lab.run("config", "check", lab.yaml, "--sim", "--set", "transport.mode=wrong", ok=False)
    lab.run("config", "check", lab.yaml, "--sim", "--set", "transport.password=1234567", ok=False)
    output = lab.printed.popitem()[1]
    assert "transport.password" in output
    assert "1234567" not in output
    lab.run("config", "check", lab.yaml, "--sim", "--set", "transport={type: zenoh, password: 1234567}", ok=False)
    assert "1234567" not in lab.printed.popitem()[1]
    assert lab.leaks() == []
