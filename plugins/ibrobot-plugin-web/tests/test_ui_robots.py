"""The views robots and record of `ibrobot ui`, with the application in this process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from ibrobot_provenance.processes import IBROBOT
from ibrobot_terminal import GuideDescriptor, Question
from ibrobot_web.ui import robots
from ui_server import UiServer, run_ui

from ibrobot_core.app import installed_plugins

ROBOT = """# A pan axis: it turns a camera.
robot:
  name: pan
  joints:
  - {name: pan, lower: -1, upper: 1, max_velocity: 1, max_acceleration: 5}
  description: {poses: {home: [0]}}
hardware: {type: fake}
executors:
  position: {type: position, group: all}
control_modes:
  web: {executors: [position], teleop: web}
  hold: {executors: [position]}
default_control_mode: hold
teleoperation:
  web: {type: web}
"""
WRONG = ROBOT.replace("upper: 1", "uper: 1").replace("default_control_mode: hold", "default_control_mode: holt")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "wrong.yaml").write_text(WRONG)
    (tmp_path / "arms").mkdir()
    (tmp_path / "arms" / "pan.yaml").write_text(ROBOT)
    (tmp_path / "notes.yaml").write_text("a: 1")
    return tmp_path


def test_robots_of_the_folder_are_listed_with_the_shipped_ones(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        listed = {each["robot"]: each for each in await server.get("robots/list")}
        assert listed["so101"]["source"] == "ibrobot"
        assert listed["so101"]["summary"].startswith("The SO-101")
        mine = {name: each["summary"] for name, each in listed.items() if each["source"] == "folder"}
        assert mine == {"wrong.yaml": "A pan axis", "arms/pan.yaml": "A pan axis"}

    run_ui([folder], test)


def test_robots_of_a_clone_are_listed_once_and_without_those_of_its_sources(tmp_path: Path) -> None:
    packages = tmp_path / "plugins" / "ibrobot-plugin-arm"
    for place in ("", "tests", "plugins/ibrobot-plugin-arm", "plugins/ibrobot-plugin-arm/ibrobot_arm"):
        (tmp_path / place).mkdir(parents=True, exist_ok=True)
        (tmp_path / place / "pan.yaml").write_text(ROBOT)
    for package in (tmp_path, packages):
        (package / "pyproject.toml").touch()
    configs = installed_plugins().shipped_configs()["so101"].parent

    async def test(server: UiServer) -> None:
        listed = await server.get("robots/list")
        mine = [each["robot"] for each in listed if each["source"] == "folder"]
        assert mine == ["pan.yaml", "plugins/ibrobot-plugin-arm/pan.yaml"]

    run_ui([tmp_path, configs], test)


def test_robots_in_a_folder_named_tests_are_listed_unless_it_is_that_of_a_package(tmp_path: Path) -> None:
    for place in ("tests", "arms/tests", "package/tests"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "pan.yaml").write_text(ROBOT)
    (tmp_path / "package/pyproject.toml").touch()

    async def test(server: UiServer) -> None:
        listed = await server.get("robots/list")
        mine = [each["robot"] for each in listed if each["source"] == "folder"]
        assert sorted(mine) == ["arms/tests/pan.yaml", "tests/pan.yaml"]

    run_ui([tmp_path], test)


def test_problems_are_those_of_config_check(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        found = await server.get("robots/check", robot="wrong.yaml", sim="false")
        ran = subprocess.run(
            [*IBROBOT, "config", "check", "wrong.yaml", "--json"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert found["problems"] == json.loads(ran.stdout)
        assert {(each["line"], each["path"]) for each in found["problems"]} >= {(5, "robot.joints.pan.uper")}
        for outside in ("../x.yaml", "/etc/passwd"):
            with pytest.raises(RuntimeError, match="outside the opened folders"):
                await server.get("robots/check", robot=outside)

    run_ui([folder], test)


def test_a_run_that_fails_shows_its_error(folder: Path) -> None:
    async def test(server: UiServer) -> None:
        number = (await server.post("robots/launch", robot="wrong.yaml", sim=False, mode="web"))["number"]
        job, lines = await server.job(lambda job: job["state"] == "failed")
        assert (job["number"], job["kind"], job["exit_code"]) == (number, "run", 2)
        assert "--mode=web --web" in job["command"]
        assert any("wrong.yaml:5: robot.joints.pan.uper: unknown key" in line for line in lines)
        with pytest.raises(RuntimeError, match="sim: expected true or false"):
            await server.post("robots/launch", robot="so101", sim="yes")

    run_ui([folder], test)


def test_watchers_get_the_link_for_watching_alone(folder: Path) -> None:
    from ibrobot_web.ui.robots import read_address

    line = "I viewer: http://127.0.0.1:1/?token=drive-_1  (to watch only: http://127.0.0.1:1/?token=watch)"

    async def test(server: UiServer) -> None:
        job = server.ui.jobs.start(
            "run", "Run", [f"print({line!r})"], program=(sys.executable, "-c"), read=read_address
        )
        seen, lines = await server.job(lambda job: job["state"] == "done")
        assert seen["facts"] == {"url": "http://127.0.0.1:1/?token=drive-_1"}
        assert job.json(drives=False)["facts"] == {"url": "http://127.0.0.1:1/?token=watch"}
        assert "drive" not in str(lines)

    run_ui([folder], test)


@pytest.mark.parametrize("dataset", ["", "../x", "/x", "a/../b", "-x", "x/"])
def test_a_dataset_is_a_folder_below_the_root(folder: Path, dataset: str) -> None:
    async def test(server: UiServer) -> None:
        with pytest.raises(RuntimeError, match="dataset '"):
            await server.get("record/place", dataset=dataset)

    run_ui([folder], test)


def test_the_place_of_a_session_counts_episodes_and_the_disk(folder: Path) -> None:
    for number in (1, 2):
        episode = folder / f"episodes/pick/episodes/episode_00000{number}"
        episode.mkdir(parents=True)
        (episode / "a.mcap").write_bytes(bytes(1000 * number))

    async def test(server: UiServer) -> None:
        found = await server.get("record/place", dataset="pick")
        assert (found["folder"], found["episodes"], found["episode_bytes"]) == ("episodes/pick", 2, 1500)
        assert found["free_bytes"] > 0
        assert (await server.get("record/place", dataset="new"))["episode_bytes"] is None

    run_ui([folder], test)


def test_a_session_is_started_with_the_values_of_its_form(folder: Path) -> None:
    pytest.importorskip("ibrobot_data", reason="needs ibrobot-plugin-data")

    async def test(server: UiServer) -> None:
        form = await server.get("jobs/form", command="record")
        assert [field["label"] for field in form["fields"]][:3] == ["Task", "Dataset", "Episodes"]
        for wrong in (0, 1.5, "x"):
            with pytest.raises(RuntimeError, match="Episodes: "):
                await server.post("record/start", robot="so101", sim=True, values={"episodes": wrong})
        with pytest.raises(RuntimeError, match="has no field root"):
            await server.post("record/start", robot="so101", sim=True, values={"root": "/etc"})
        with pytest.raises(RuntimeError, match="the prompt has 1001 characters; at most 1000 are allowed"):
            await server.post("record/start", robot="so101", sim=True, values={"prompt": "x" * 1001})
        values = {"episodes": 3, "prompt": "--pick", "dataset": "a b"}
        await server.post("record/start", robot="arms/pan.yaml", sim=False, mode="nope", values=values)
        job, _ = await server.job(lambda job: job["state"] == "failed")
        assert f"--root={folder / 'episodes'} --dataset=a b --prompt=--pick --episodes=3" in job["command"]
        assert "nope" in job["facts"]["error"]
        values = {"convert": False, "convert_outcome": ["success"], "convert_out": "datasets/a"}
        await server.post("record/start", robot="arms/pan.yaml", sim=False, mode="nope", values=values)
        job, _ = await server.job(lambda job: job["number"] == 2 and job["state"] == "failed")
        assert "convert" not in job["command"], "what the form suggests asks for no conversion"
        values["convert"] = True
        await server.post("record/start", robot="arms/pan.yaml", sim=False, mode="nope", values=values)
        job, _ = await server.job(lambda job: job["number"] == 3 and job["state"] == "failed")
        assert f"--convert --convert-out={folder / 'datasets/a'} --convert-outcome=success" in job["command"]

    run_ui([folder], test)


def test_links_out_of_the_folder_are_not_followed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "secret.yaml").write_text(ROBOT.replace("A pan axis", "The password is swordfish"))
    (folder / "linked.yaml").symlink_to(outside / "secret.yaml")
    (folder / "arms" / "arm.yaml").symlink_to(folder / "arms" / "pan.yaml")

    async def test(server: UiServer) -> None:
        listed = await server.get("robots/list")
        assert "swordfish" not in json.dumps(listed)
        mine = {each["robot"] for each in listed if each["source"] == "folder"}
        assert mine == {"wrong.yaml", "arms/pan.yaml", "arms/arm.yaml"}, "a link within the folder is no way out of it"

    run_ui([folder], test)


def test_a_bundled_robot_is_copied_with_ports_of_what_was_found(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = "/dev/serial/by-id/usb-arm"
    guide = GuideDescriptor(
        "port",
        label="Port",
        summary="",
        make=lambda answers, guide: None,
        questions=lambda: (Question("port", "", "", (port,)),),
    )
    monkeypatch.setattr(robots, "installed_guides", lambda: [guide])

    async def test(server: UiServer) -> None:
        offered = await server.get("robots/copying", robot="so101")
        found = {each["name"]: (each["default"], each["found"]) for each in offered["variables"]}
        assert found["IBROBOT_FOLLOWER_PORT"] == ("/dev/ttyACM0", [port])
        assert found["IBROBOT_TOP_CAMERA"] == ("0", [])
        values = {"IBROBOT_FOLLOWER_PORT": port, "IBROBOT_TOP_CAMERA": "4", "IBROBOT_LEADER_PORT": ""}
        made = await server.post("robots/copy", robot="so101", file=offered["file"], values=values)
        assert made == {"robot": "my_so101.yaml"}
        copied = (folder / "my_so101.yaml").read_text()
        assert f'port: "${{IBROBOT_FOLLOWER_PORT:{port}}}"' in copied
        assert 'device: "${IBROBOT_TOP_CAMERA:4}"' in copied
        assert '"${IBROBOT_LEADER_PORT:/dev/ttyACM1}"' in copied, "an empty field keeps the default"
        for file, why in (("my_so101.yaml", "exists already"), ("../x.yaml", "outside"), ("x.txt", "ends with .yaml")):
            with pytest.raises(RuntimeError, match=why):
                await server.post("robots/copy", robot="so101", file=file, values={})

    run_ui([folder], test)
