"""The files in `deploy/`: valid, and their command lines are those of this version."""

from __future__ import annotations

import configparser
import copy
import json
import shlex
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import jsonschema
import pytest
import yaml
from ibrobot_http.probes import Probes, ProbeServer
from ibrobot_testing.command import command_line

DEPLOY = Path(__file__).parents[1] / "deploy"
SCHEMA = json.loads((Path(__file__).parent / "kubernetes/schema.json").read_text())
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all((DEPLOY / "kubernetes.yaml").read_text()))
POD = next(each for each in OBJECTS if each["kind"] == "StatefulSet")["spec"]["template"]["spec"]
CONTAINERFILE = (DEPLOY / "Containerfile").read_text().replace("\\\n", "")
serve = command_line("serve")
UNIT = DEPLOY / "ibrobot-serve@.service"


def validate(document: dict[str, Any]) -> None:
    """Check a Kubernetes object against the schema of its kind."""
    group = {"v1": "core.v1", "apps/v1": "apps.v1", "policy/v1": "policy.v1"}[document["apiVersion"]]
    schema = {**SCHEMA, "$ref": f"#/$defs/io.k8s.api.{group}.{document['kind']}"}
    jsonschema.Draft202012Validator(schema).validate(document)  # checking the schema as well takes seconds


@pytest.mark.parametrize("document", OBJECTS, ids=lambda document: document["kind"])
def test_manifest_follows_its_schema(document: dict[str, Any]) -> None:
    validate(document)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("spec.replicas", "three"),
        ("spec.template.spec.containers.0.livenessProb", {}),
        ("spec.template.spec.containers.0.livenessProbe.exec.command", "python"),
        ("spec.template.spec.terminationGracePeriod", 30),
    ],
)
def test_schema_knows_a_wrong_manifest(path: str, value: Any) -> None:
    document = copy.deepcopy(next(each for each in OBJECTS if each["kind"] == "StatefulSet"))
    *parents, last = path.split(".")
    at: Any = document
    for key in parents:
        at = at[int(key) if key.isdecimal() else key]
    at[last] = value
    with pytest.raises(jsonschema.ValidationError):
        validate(document)


def containerfile(instruction: str) -> list[str]:
    """The JSON list of an instruction."""
    (line,) = [line for line in CONTAINERFILE.splitlines() if line.startswith(instruction)]
    found: list[str] = json.loads(line.removeprefix(instruction))
    return found


def unit() -> configparser.SectionProxy:
    """The section `Service`."""
    parser = configparser.RawConfigParser(strict=False)
    parser.optionxform = str  # type: ignore[assignment,method-assign]  # as configparser's documentation does
    parser.read_string(UNIT.read_text().replace("\\\n", ""))
    return parser["Service"]


COMMANDS = {
    "container": [*containerfile("ENTRYPOINT "), *containerfile("CMD ")],
    "pod": [*containerfile("ENTRYPOINT "), *POD["containers"][0]["args"]],
    "unit": ["ibrobot", *shlex.split(unit()["ExecStart"])[1:]],
}


@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_command_line_is_right(command: list[str]) -> None:
    assert command[:2] == ["ibrobot", "serve"]
    options = click.Context(serve).invoke(serve.make_context, "serve", command[2:]).params
    assert options["listen"] == ("tls/0.0.0.0:7447",)
    assert options["metrics_port"] == 9465
    assert "lease=0.7" in options["transport_options"]


def test_server_has_time_to_drain() -> None:
    drain_s = serve.make_context("serve", COMMANDS["pod"][2:]).params["drain"]
    assert POD["terminationGracePeriodSeconds"] > drain_s
    assert int(unit()["TimeoutStopSec"]) > serve.make_context("serve", COMMANDS["unit"][2:]).params["drain"]
    assert "STOPSIGNAL SIGTERM" in CONTAINERFILE
    assert unit()["KillSignal"] == "SIGTERM"


def of(kind: str) -> list[dict[str, Any]]:
    """The objects of a kind."""
    return [each for each in OBJECTS if each["kind"] == kind]


def test_each_server_has_an_address_outside_the_cluster() -> None:
    (servers,) = of("StatefulSet")
    pods = {f"{servers['metadata']['name']}-{number}" for number in range(servers["spec"]["replicas"])}
    outside = [each["spec"] for each in of("Service") if each["spec"].get("type") in ("LoadBalancer", "NodePort")]
    assert {each["selector"]["statefulset.kubernetes.io/pod-name"] for each in outside} == pods
    assert {each["ports"][0]["port"] for each in outside} == {POD["containers"][0]["ports"][0]["containerPort"]}


def test_servers_are_spread_over_nodes() -> None:
    (spread,) = POD["topologySpreadConstraints"]
    (servers,) = of("StatefulSet")
    assert spread["topologyKey"] == "kubernetes.io/hostname"
    assert spread["labelSelector"]["matchLabels"] == servers["spec"]["selector"]["matchLabels"]


def test_claim_of_the_model_lets_pods_on_all_nodes_read_it() -> None:
    claims = {each["metadata"]["name"]: each["spec"]["accessModes"] for each in of("PersistentVolumeClaim")}
    (used,) = [volume["persistentVolumeClaim"] for volume in POD["volumes"] if "persistentVolumeClaim" in volume]
    assert claims == {used["claimName"]: ["ReadOnlyMany"]}
    assert used["readOnly"]


def test_image_has_a_tag_and_is_not_pulled_at_every_start() -> None:
    (container,) = POD["containers"]
    _, _, tag = container["image"].rpartition("/")[2].partition(":")
    assert tag not in ("", "latest")
    assert container["imagePullPolicy"] == "IfNotPresent"
    assert f"-t ibrobot-serve:{tag} " in CONTAINERFILE


def test_unit_runs_the_program_of_the_virtual_environment_that_it_names() -> None:
    """Without the variables of a shell, as systemd does."""
    program = Path(shlex.split(unit()["ExecStart"])[0])
    environment = program.parents[1]
    assert f"python3 -m venv {environment}" in UNIT.read_text()
    assert not environment.is_relative_to("/home"), "ProtectHome"
    here = Path(sysconfig.get_path("scripts")) / program.relative_to(environment / "bin")
    command = [str(here), "serve", "--help"]
    done = subprocess.run(command, env={"PATH": "/usr/bin"}, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "MODEL_DIR" in done.stdout


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_accepts_the_unit(tmp_path: Path) -> None:
    right, wrong = tmp_path / "ibrobot-serve@pick.service", tmp_path / "wrong@pick.service"
    # `verify` wants to find the program.
    text = UNIT.read_text().replace("/opt/ibrobot/bin", sysconfig.get_path("scripts"))
    right.write_text(text)
    wrong.write_text(text.replace("Restart=always", "Restart=allways"))
    done = subprocess.run(
        ["systemd-analyze", "verify", right, wrong], capture_output=True, text=True, timeout=60, check=False
    )
    assert "allways" in done.stderr
    assert "ibrobot-serve@" not in done.stderr, done.stderr


@pytest.fixture
def state() -> Iterator[tuple[int, dict[str, str]]]:
    """The port of a server's probes, and why they fail."""
    why = {"unhealthy": "", "unready": ""}
    server = ProbeServer(0, Probes(lambda: b"", lambda: why["unhealthy"], lambda: why["unready"]))
    yield int(server.url.rpartition(":")[2].partition("/")[0]), why
    server.close()


@pytest.mark.parametrize(("probe", "fault"), [("readinessProbe", "unready"), ("livenessProbe", "unhealthy")])
def test_probe_fails_when_the_server_does(state: tuple[int, dict[str, str]], probe: str, fault: str) -> None:
    port, why = state
    _, flag, code = POD["containers"][0][probe]["exec"]["command"]
    command = [sys.executable, flag, code.replace("9465", str(port))]
    assert subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 0
    why[fault] = "the server is stopping"
    assert subprocess.run(command, capture_output=True, timeout=60, check=False).returncode == 1
