"""The view episodes of `ibrobot ui`: recordings are listed, played back, judged, trimmed, deleted and restored."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import attrs
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from ibrobot_provenance.processes import IBROBOT
from ibrobot_testing.command import command_line
from ibrobot_web.playback import Playback
from ibrobot_web.ui.folders import Folders
from ibrobot_web.ui.forms import choices_of
from ibrobot_web.ui.recordings import Episodes, find_recordings
from ui_server import UiServer, run_ui

from ibrobot_core.api import IbrobotError
from ibrobot_core.app import find_config, installed_plugins

pytest.importorskip("ibrobot_mcap", reason="needs ibrobot-plugin-mcap")
TOP = "/camera/top/image_raw"
MODEL = '<mujoco><worldbody><body name="arm"><joint name="pan"/><geom size="0.1"/></body></worldbody></mujoco>'


@pytest.fixture
def episode(tmp_path: Path) -> Path:
    from made_episodes import make_episode

    (tmp_path / "arm.xml").write_text(MODEL)
    config = {"robot": {"description": {"mjcf": "arm.xml", "tip": "tool"}}}
    return make_episode(tmp_path / "pick/episodes/episode_000001", prompt="pick", robot="arm", config=config)


@pytest.fixture
def opened(episode: Path) -> Iterator[Playback]:
    found = Playback(episode)
    yield found
    found.close()


def test_the_motion_and_plots_are_thinned(opened: Playback) -> None:
    facts = opened.facts()
    motion = facts["motion"]
    assert (facts["task"], facts["duration_s"], facts["cameras"]) == ("pick", 1.0, [TOP])
    assert motion["joints"] == ["pan", "tilt"]
    assert 24 <= len(motion["times"]) <= 31
    assert motion["positions"][-1] == pytest.approx([motion["times"][-1], 2 * motion["times"][-1]])
    series = opened.series("/joint_states")
    assert series["values"]["position.tilt"][-1] == pytest.approx(2 * series["times"][-1])
    with pytest.raises(IbrobotError, match="has no topic '/imu'; available: "):
        opened.series("/imu")


def test_an_overview_counts_what_the_folders_contain(episode: Path, tmp_path: Path) -> None:
    (tmp_path / "my_arm.yaml").write_text("# An arm.\nrobot:\n  name: mine\n")

    async def test(server: UiServer) -> None:
        found = await server.get("robots/overview")
        assert found["robots"] == [{"robot": "my_arm.yaml", "summary": "An arm"}]
        assert (found["episodes"], found["unjudged"], found["datasets"], found["policies"]) == (1, 0, [], [])
        assert found["newest"][0] | {"began_s": None} == {
            "path": "pick/episodes/episode_000001",
            "task": "pick",
            "outcome": "success",
            "began_s": None,
        }

    run_ui([tmp_path], test)


def test_an_overview_counts_trainings_not_their_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [tmp_path / f"training/pick/checkpoints/{step}/pretrained_model" for step in ("000010", "000020")]
    alone = tmp_path / "of_a_friend"
    monkeypatch.setattr("ibrobot_web.ui.robots.find_policies", lambda ui: [(path, "act") for path in (*steps, alone)])

    async def test(server: UiServer) -> None:
        assert (await server.get("robots/overview"))["policies"] == ["of_a_friend", "training/pick"]

    run_ui([tmp_path], test)


def brightness(picture: Any) -> int:
    import simplejpeg

    return int(np.median(simplejpeg.decode_jpeg(picture.content)))


def test_pictures_are_the_newest_at_a_time_in_any_order(opened: Playback) -> None:
    for at_s in (0.0, 0.21, 0.2, 1.0, 0.5, 0.519, 0.0):
        assert brightness(opened.picture(TOP, at_s)) == pytest.approx(int(at_s / 0.02 + 1e-6), abs=1)
    assert opened.picture(TOP, 1.9) is not None
    assert opened.picture(TOP, 2.1) is None, "a camera that fell silent shows nothing old"


def test_objects_of_the_simulated_scene_are_where_they_were(opened: Playback, tmp_path: Path) -> None:
    assert opened.objects(Path) == [], "nothing is known of a scene"
    if ("hardware", "mujoco") not in installed_plugins().entries:
        pytest.skip("needs ibrobot-plugin-mujoco")
    from made_episodes import make_episode

    robot = yaml.safe_load(Path(find_config("so101_pick_cube", installed_plugins())).read_text(encoding="utf-8"))
    pose = [0.1, 0.2, 0.3, 1.0, 0.0, 0.0, 0.0]
    scene = {"/simulation/scene": [*pose, 0.1, 0.24, 0.0]}
    path = make_episode(tmp_path / "picked", 0.1, cameras=(), config=robot, signals=scene)
    found = Playback(path)
    cube, *parts = found.objects(Path)
    assert (cube["name"], cube["times"][0], cube["poses"][-1]) == ("cube", 0.0, pose)
    assert {each["name"].partition("_")[0] for each in parts} == {"bin"}
    assert all(each["poses"] == [] for each in parts)
    found.close()


def test_a_model_outside_the_opened_folders_is_not_read(episode: Path, tmp_path: Path) -> None:
    other = {
        "/etc/hostname": "outside the opened",
        "package://yaml/../../../../etc/hostname": "out of its package",
        "../a.xml": "outside the opened",
    }

    async def test(server: UiServer) -> None:
        scene = await server.get("episodes/scene", path=str(episode))
        assert [body["name"] for body in scene["bodies"]] == ["world", "arm"]
        found = server.ui.keep(Episodes).opened(episode)
        for mjcf, problem in other.items():
            config = json.dumps({"robot": {"description": {"mjcf": mjcf}}})
            found.summary = attrs.evolve(found.summary, metadata={"config": config})
            scene = await server.get("episodes/scene", path=str(episode))
            assert scene["bodies"] == []
            assert problem in scene["problem"]
        server.ui.keep(Episodes).close()

    run_ui([tmp_path], test)


def run_here(command: Sequence[str], **_: Any) -> subprocess.CompletedProcess[str]:
    """A command in this process, which is faster."""
    group, *arguments = command[len(IBROBOT) :]
    result = CliRunner().invoke(command_line(group), arguments, catch_exceptions=False)
    errors = result.stderr if result.stderr_bytes is not None else ""  # the oldest click mixes it into stdout
    return subprocess.CompletedProcess(command, result.exit_code, result.stdout, errors)


def test_episodes_are_judged_trimmed_deleted_and_restored(
    episode: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def test(server: UiServer) -> None:
        async def row() -> Any:
            (found,) = (await server.get("episodes/list"))["episodes"]
            return found

        path = (await row())["path"]
        assert ((await row())["group"], (await row())["outcome"], (await row())["duration_s"]) == (
            "pick",
            "success",
            1.0,
        )
        await server.post("episodes/mark", paths=[path], outcome="failure")
        monkeypatch.setattr("ibrobot_web.ui.forms.subprocess.run", run_here)
        assert (await row())["outcome"] == "failure"
        assert (await server.get("episodes/open", path=path))["outcome"] == "failure"
        await server.post("episodes/trim", path=path, begin_s=0.2, end_s=0.6)
        assert (await row())["duration_s"] == pytest.approx(0.4)
        await server.post("episodes/delete", paths=[path])
        listed = await server.get("episodes/list")
        assert (listed["episodes"], listed["trashes"]) == ([], ["pick/episodes"])
        deleted, original = await server.get("episodes/trash", path="pick/episodes")
        assert (deleted["what"], original["what"]) == ("deleted", "trimmed; this is the original")
        await server.post("episodes/restore", path="pick/episodes", id=original["id"])
        assert (await row())["duration_s"] == 1.0
        server.ui.keep(Episodes).close()

    run_ui([tmp_path], test)


def test_what_is_outside_or_malformed_is_refused(episode: Path, tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "link").symlink_to(episode.parent)

    async def test(server: UiServer) -> None:
        for path in (str(episode), f"../{episode.relative_to(tmp_path)}", "link/episode_000001", "..", "/etc", "a\0b"):
            facts: dict[str, Any]
            topic = {"topic": TOP}
            for name, more in {
                "open": {},
                "series": topic,
                "picture": {**topic, "at_s": "0"},
                "scene": {},
                "trash": {},
            }.items():
                answer = server.get(f"episodes/{name}", path=path, **more)
                if name == "scene" and "\0" not in path:
                    assert (await answer)["bodies"] == []
                    continue
                with pytest.raises(RuntimeError, match=r"outside the opened folders|control character"):
                    await answer
            requests: dict[str, dict[str, Any]] = {
                "trim": {"begin_s": 0, "end_s": 1},
                "repair": {},
                "restore": {"id": "x"},
                "empty": {},
            }
            for name, facts in requests.items():
                with pytest.raises(RuntimeError, match=r"outside the opened folders|control character"):
                    await server.post(f"episodes/{name}", path=path, **facts)
            for name, facts in {"mark": {"outcome": "success"}, "delete": {}}.items():
                with pytest.raises(RuntimeError, match=r"outside the opened folders|control character"):
                    await server.post(f"episodes/{name}", paths=[path], **facts)
        wrong: Any
        for wrong in ("paths", [], [1], {"a": 1}, None):
            with pytest.raises(RuntimeError, match="paths"):
                await server.post("episodes/delete", paths=wrong)
        for wrong in ("nan", "inf", -1, None, "1 s", [], {}):
            with pytest.raises(RuntimeError, match="begin_s"):
                await server.post("episodes/trim", path=".", begin_s=wrong, end_s=1)
        for wrong in ("--help", "", "discarded", None, ["success"]):
            with pytest.raises(RuntimeError, match=r"(?i)outcome"):
                await server.post("episodes/mark", paths=["."], outcome=wrong)
        assert await server.get("episodes/list") == {
            "episodes": [],
            "complete": True,
            "trashes": [],
            "outcomes": choices_of("episodes mark", "outcome"),
        }

    run_ui([inside], test)
    assert episode.is_dir()


def test_hidden_folders_and_links_are_not_looked_into(episode: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(episode.parent)
    episode.parent.rename(tmp_path / ".hidden")
    assert find_recordings(Folders([tmp_path])).episodes == ()
