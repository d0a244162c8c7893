"""`ibrobot record --convert`: episodes are converted while the session goes on; the dataset is that of a conversion."""

from __future__ import annotations

import json
import logging
import random
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess
from types import SimpleNamespace
from typing import Any, ClassVar

import attrs
import pytest
from command_line import run_here
from ibrobot_data import beside
from ibrobot_data.beside import ConversionBeside, Orders
from ibrobot_data.command import Convert, conversion_request
from ibrobot_data.episode_service import EpisodeService
from ibrobot_data.growing import GrowingEpisode
from ibrobot_data.operator import Operator
from ibrobot_data.run import follow, stage
from ibrobot_data.written import WrittenEpisode
from ibrobot_provenance.recorded_names import COMMANDER
from ibrobot_testing.site import made_up_site

from ibrobot_core.api import RecorderError, String
from ibrobot_core.app import Child, ComponentFailed, LaunchRequest, Runtime, Session, installed_plugins, load_config

pytestmark = pytest.mark.usefixtures("fork_server")
ROBOT = """\
robot:
  name: mini
  joints: [{name: pan, lower: -1.0, upper: 1.0, max_velocity: 2.0, max_acceleration: 10.0}]
  groups: {arm: [pan]}
hardware: {type: arm}
simulation: {type: scene}
executors:
  arm_position: {type: position, group: arm}
control_modes:
  teleop: {executors: [arm_position], teleop: stick}
default_control_mode: teleop
teleoperation:
  stick: {type: stick}
contract:
  rate_hz: 25
  max_duration_s: 0.4
  observations:
    - {key: observation.state, topic: /joint_states, select: [position.pan]}
  actions:
    - {executor: arm_position, topic: /arm/commands}
control: {rate_hz: 50, stop: hold}
recording: {type: json, root: kept, dataset: pick}
"""
RECORD = ("record", "mini.yaml", "--sim", "--lockstep", "--headless", "--auto", "--prompt", "pick")
CONVERT = ("--convert", "--convert-type", "json")


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder with a robot whose episodes and datasets are JSON."""
    monkeypatch.chdir(tmp_path)
    Path("mini.yaml").write_text(ROBOT)
    with made_up_site(tmp_path / "site", Path(__file__).parent, monkeypatch) as site:
        site.add("arms", "arms.py")
        site.add("json-files", "json_files.py")
        yield


def convert(out: str, *more: str) -> CompletedProcess[str]:
    return run_here("convert", "kept/pick", "--out", out, "--type", "json", "--jobs", 1, *more)


def files(folder: str) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


@attrs.frozen
class Recording:
    """A session, its operator, and the conversion beside it."""

    runtime: Runtime
    operator: Operator
    beside: ConversionBeside

    def step(self, count: int = 3) -> None:
        for _ in range(count):
            self.operator.step()
            assert not self.runtime.step()

    def episode(self, end: str = "tab") -> None:
        """Record one, which ends as a success by default."""
        self.operator.key("tab")
        self.step()
        self.operator.key(end)
        self.step()


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], Recording]]:
    monkeypatch.setattr(beside, "_PATIENCE_S", 120.0)
    made: list[Recording] = []

    def start() -> Recording:
        registry = installed_plugins()
        config = load_config("mini.yaml", mode="teleop", sim=True, registry=registry)
        runtime = Runtime(Session(config, registry, LaunchRequest(lockstep=True, by_operator=True)))
        service = runtime.session.episodes
        assert isinstance(service, EpisodeService)
        options = Convert(episodes=(Path("kept/pick"),), out=Path("set"), append=True, type_="json")
        converts = ConversionBeside(options, service, logging.getLogger("ibrobot.data"))
        operator = Operator(runtime.session, service, None, 0.0, "pick", auto=False, keys=True, beside=converts)
        made.append(Recording(runtime, operator, converts))
        runtime.start()
        made[-1].step(5)
        return made[-1]

    yield start
    for each in made:
        each.runtime.stop()
        each.beside.finish()


def kept() -> list[str]:
    """The episodes that are converted, and not added to the dataset yet."""
    units = Path("set/.staging").glob("*/episode.json")
    return sorted(json.loads(path.read_text())["report"]["source"] for path in units)


def test_the_dataset_is_there_at_the_end_as_if_it_were_converted_afterwards():
    done = run_here(*RECORD, *CONVERT, "--episodes", 2)
    assert done.returncode == 0, done.stderr
    assert "2 episodes, " in done.stdout
    assert "-> datasets/pick" in done.stdout
    assert convert("later").returncode == 0
    assert files("datasets/pick") == files("later")


def test_a_later_session_adds_its_episodes_and_what_is_not_converted_yet():
    assert run_here(*RECORD, "--episodes", 1).returncode == 0
    done = run_here(*RECORD, *CONVERT, "--episodes", 2, "--resume", "--seed", 1, "--convert-out", "set")
    assert done.returncode == 0
    assert len(json.loads(Path("set/dataset.json").read_text())["episodes"]) == 2
    shutil.rmtree("set")
    done = run_here(*RECORD, *CONVERT, "--episodes", 2, "--resume", "--convert-out", "set")
    assert "has 2 episodes already" in done.stdout
    assert len(json.loads(Path("set/dataset.json").read_text())["episodes"]) == 2


@pytest.mark.parametrize(
    ("options", "error"),
    [
        (["--convert-outcome", "success"], "--convert-outcome needs --convert"),
        (["--convert-out", "set"], "--convert-out needs --convert"),
        ([*CONVERT, "--convert-set", "what=1"], "what"),
    ],
)
def test_options_that_do_not_fit_are_refused_before_the_robot_moves(options: list[str], error: str):
    done = run_here(*RECORD, "--episodes", 1, *options)
    assert done.returncode != 0
    assert error in done.stderr
    assert not Path("kept").exists()


def test_a_dataset_with_other_settings_is_refused_before_the_robot_moves():
    assert run_here(*RECORD, *CONVERT, "--episodes", 1).returncode == 0
    done = run_here(*RECORD, *CONVERT, "--episodes", 1, "--convert-norm-mode", "degrees")
    assert done.returncode != 0
    assert "datasets/pick: was made with other settings: norm_mode radians, now degrees" in done.stderr
    assert len(list(Path("kept/pick/episodes").iterdir())) == 1


def test_an_episode_is_converted_while_the_session_goes_on(session: Callable[[], Recording]):
    run = session()
    run.episode()
    run.beside.finish()
    assert kept() == ["pick/episode_000001"]
    assert "1 episode converted for set" in dict(run.operator.rows())["dataset"]
    done = convert("set", "--append")
    assert "2 frames, 1 of them by an earlier run" in done.stdout


def test_an_episode_that_is_marked_later_is_converted_again(session: Callable[[], Recording]):
    run = session()
    run.episode()
    run.beside.finish()
    recorded = Path("kept/pick/episodes/episode_000001/episode.json")
    recorded.write_text(json.dumps({**json.loads(recorded.read_text()), "outcome": "failure"}))
    assert "by an earlier run" not in convert("set", "--append").stdout
    assert json.loads(Path("set/dataset.json").read_text())["metadata"]["episodes"][0]["outcome"] == "failure"


def test_an_episode_that_is_recorded_again_is_left_to_its_deletion(session: Callable[[], Recording]):
    run = session()
    run.episode()
    assert "episode_000001 follows" in dict(run.operator.rows())["dataset"]
    assert run.operator.key("backspace")
    run.step()
    assert "episode_000001" not in dict(run.operator.rows())["dataset"]
    run.operator.key("tab")
    run.step()
    run.beside.finish()
    assert [path.name for path in Path("kept/pick/episodes").glob("[!.]*")] == ["episode_000002"]
    assert kept() == ["pick/episode_000002"]


def test_a_session_that_dies_leaves_what_an_interrupted_conversion_leaves(session: Callable[[], Recording]):
    run = session()
    run.episode()
    run.beside.finish()
    shutil.rmtree("set")
    options = {"episodes": ["kept/pick/episodes/episode_000001"], "out": "set", "append": True, "type_": "json"}
    child = Child("ibrobot_data.beside", {"options": options, "growing": False}, end_s=60.0)
    child.channel.send({"paused": True})
    child.channel.close()
    assert not child.end(), "it ends by itself"
    assert kept() == []
    assert not [path for path in Path(".").glob("set/**/*") if ".making." in path.name]
    assert convert("set").returncode == 0


class Messages:
    """A channel on which each call of `receive` gets the next of these lists of messages."""

    closed = False

    def __init__(self, *messages: list[dict[str, bool]]) -> None:
        self.messages = list(messages)
        self.waits: list[float | None] = []

    def receive(self, timeout_s: float | None = 0.0) -> list[dict[str, bool]]:
        self.waits.append(timeout_s)
        return self.messages.pop(0)


def test_a_conversion_waits_until_it_may_go_on():
    channel: Any = Messages([], [{"paused": True}], [], [{"paused": False}], [])
    orders = Orders(channel)
    orders.pass_on(1)
    assert channel.waits == [0.0]
    orders.pass_on(1)
    assert channel.waits == [0.0, 0.0, None, None]
    orders.pass_on(1)
    assert channel.waits == [0.0, 0.0, None, None, 0.0]
    channel.closed, channel.messages = True, [[]]
    with pytest.raises(ComponentFailed, match="the session has ended"):
        orders.pass_on(1)


def test_a_conversion_learns_of_the_end_of_its_recording_even_while_it_waits():
    channel: Any = Messages([], [{"paused": True}], [{"ended": True}], [{"paused": False}])
    orders = Orders(channel, growing=True)
    assert not orders.has_ended(0.5)
    orders.pass_on(1)
    assert orders.has_ended(0.5)
    assert channel.waits == [0.5, 0.0, None, None]


class Process:
    """A process that never ends by itself."""

    made: ClassVar[list[Process]] = []

    def __init__(self, program: str, order: Any, *, end_s: float) -> None:
        self.made.append(self)
        self.channel = self
        self.sent: list[Any] = []
        self.episode, self.growing = order["options"]["episodes"][0], order["growing"]
        self.send, self.kill, self.close = self.sent.append, lambda: None, lambda: None
        self.end = lambda: True

    def wait(self, timeout_s: float) -> None:
        return None


@pytest.mark.parametrize("need", [{"lost": {"/camera": 1}}, {"waiting_bytes": 1 << 30}])
def test_a_conversion_makes_room_for_a_recording_that_needs_the_machine(
    monkeypatch: pytest.MonkeyPatch, need: dict[str, Any]
):
    monkeypatch.setattr(beside, "Child", Process)
    monkeypatch.setattr(Process, "made", [])
    status = SimpleNamespace(lost={}, waiting_bytes=0)
    first = WrittenEpisode(Path("episode_000001"), "success", "success", whole=True)
    service: Any = SimpleNamespace(written=[first], replaced=None, running=False, writing=False, status=lambda: status)
    options = Convert(episodes=(Path("kept"),), out=Path("set"), append=True)
    converts = ConversionBeside(options, service, logging.getLogger("ibrobot.data"))
    converts.step()
    (process,) = Process.made
    service.running = True
    converts.step()
    assert process.sent == []
    vars(status).update(need)
    converts.step()
    assert process.sent == [{"paused": True}]
    service.running = False
    converts.step()
    assert process.sent == [{"paused": True}, {"paused": False}]
    vars(status).update(lost={}, waiting_bytes=0)
    service.running = True
    converts.step()
    assert process.sent[2:] == [{"paused": True}], "the next recording needs it, too"
    service.running = False
    service.writing = True
    converts.step()
    assert process.sent[3:] == []


@pytest.fixture
def present(monkeypatch: pytest.MonkeyPatch) -> tuple[ConversionBeside, Any, Process]:
    """A conversion that follows `episode_000001`, the service that records it, and the process."""
    monkeypatch.setattr(beside, "Child", Process)
    monkeypatch.setattr(Process, "made", [])
    status = SimpleNamespace(lost={}, waiting_bytes=0)
    episode = Path("episode_000001")
    service: Any = SimpleNamespace(
        written=[], replaced=None, running=True, writing=False, present=None, status=lambda: status
    )
    options = Convert(episodes=(Path("kept"),), out=Path("set"), append=True, outcome=("success",))
    converts = ConversionBeside(options, service, logging.getLogger("ibrobot.data"))
    converts.step()
    assert Process.made == [], "it has no folder yet"
    service.present = episode
    converts.step()
    converts.step()
    (process,) = Process.made
    assert (process.episode, process.growing, process.sent) == (str(episode), True, [])
    return converts, service, process


def test_an_episode_is_followed_until_it_is_written(present: tuple[ConversionBeside, Any, Process]):
    converts, service, process = present
    service.running, service.writing = False, True
    converts.step()
    assert process.sent == []
    service.written = [WrittenEpisode(Path("episode_000001"), "success", "success", whole=True)]
    service.writing, service.present = False, None
    converts.step()
    converts.step()
    assert process.sent == [{"ended": True}]
    assert Process.made == [process]
    assert converts.row() == "0 episodes converted for set; episode_000001 follows"


@pytest.mark.parametrize(
    "written",
    [
        [],
        [WrittenEpisode(Path("episode_000001"), "success", "success", whole=False)],
        [WrittenEpisode(Path("episode_000001"), "failure", "failure", whole=True)],
    ],
    ids=["discarded", "unfinished", "unwanted"],
)
def test_an_episode_that_is_not_wanted_is_followed_no_longer(
    present: tuple[ConversionBeside, Any, Process], written: list[WrittenEpisode]
):
    converts, service, process = present
    service.running, service.present, service.written = False, None, written
    converts.step()
    assert process.sent == []
    assert converts.row() == "0 episodes converted for set"
    assert Process.made == [process]


def test_the_end_of_a_session_does_not_wait_for_a_starved_process(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(beside, "Child", Process)
    monkeypatch.setattr(Process, "made", [])
    times = iter(range(100))
    monkeypatch.setattr(time, "monotonic", lambda: float(next(times)))
    first = WrittenEpisode(Path("episode_000001"), "success", "success", whole=True)
    service: Any = SimpleNamespace(written=[first], replaced=None, running=False, writing=False)
    options = Convert(episodes=(Path("kept"),), out=Path("set"), append=True)
    converts = ConversionBeside(options, service, logging.getLogger("ibrobot.data"))
    converts.step()
    converts.finish()
    assert 3 < next(times) < 30
    assert converts.row() == "0 episodes converted for set", "the conversion at the end of the session takes it"


@pytest.mark.parametrize(
    "episode",
    [
        WrittenEpisode(Path("episode_000001"), "success", "success", whole=False),
        WrittenEpisode(Path("episode_000001"), "failure", "failure", whole=True),
    ],
)
def test_unfinished_and_unwanted_episodes_are_not_converted(monkeypatch: pytest.MonkeyPatch, episode: WrittenEpisode):
    monkeypatch.setattr(beside, "Child", Process)
    monkeypatch.setattr(Process, "made", [])
    service: Any = SimpleNamespace(written=[episode], replaced=None, running=False, writing=False)
    options = Convert(episodes=(Path("kept"),), out=Path("set"), append=True, outcome=("success",))
    ConversionBeside(options, service, logging.getLogger("ibrobot.data")).step()
    assert Process.made == []


EPISODE = Path("kept/pick/episodes/episode_000001")


class Growing:
    """A recorded episode that grows in another folder, by some messages each time it is asked whether it has ended."""

    def __init__(self, parts: list[int]) -> None:
        self.episode = Path("grown/pick/episodes/episode_000001")
        shutil.rmtree("grown", ignore_errors=True)
        shutil.copytree(EPISODE, self.episode)
        self.found: dict[str, Any] = json.loads((EPISODE / "episode.json").read_text())
        self.messages: list[Any] = self.found["messages"]
        self.parts: list[int | None] = [*parts, None]
        self.left = -1
        self.has_ended(0.0)

    def has_ended(self, timeout_s: float) -> bool:
        if self.left == 0:
            return True
        count = self.parts.pop(0)
        part = {**self.found, "messages": self.messages[:count]}
        self.left = len(self.messages) - len(part["messages"])
        if self.left:
            part["outcome"] = "unknown"
        (self.episode / "episode.json").write_text(json.dumps(part))
        return False

    def unit(self, convert: Callable[..., Any], *more: Any) -> dict[str, Any]:
        """The unit that a conversion makes, without what depends on times of files."""
        shutil.rmtree("set", ignore_errors=True)
        options = Convert(episodes=(self.episode,), out=Path("set"), append=True, type_="json")
        report = convert(conversion_request(options), self.episode, lambda frames: None, *more)
        assert report is not None
        assert not report.error, report.error
        (unit,) = Path("set/.staging").glob("*/")
        record = json.loads((unit / "episode.json").read_text())
        return {**record, "key": "", "dataset": (unit / "dataset/dataset.json").read_text()}


@pytest.fixture
def recorded() -> int:
    """The number of messages of a recorded episode."""
    assert run_here(*RECORD, "--episodes", 1, "--set", "contract.max_duration_s=2.0").returncode == 0
    return len(json.loads((EPISODE / "episode.json").read_text())["messages"])


def test_an_episode_that_grows_is_converted_as_if_it_were_whole(recorded: int):
    whole = Growing([]).unit(stage)
    assert whole["report"]["frames"] > 20
    for seed in range(30):
        draw = random.Random(seed)
        parts = sorted(draw.sample(range(1, recorded), draw.randrange(1, 12)))
        growing = Growing(parts)
        assert growing.unit(follow, growing.has_ended) == whole, seed
        followed = Growing(parts)
        read = [
            (each.topic, each.received_ns) for each in GrowingEpisode(followed.episode, followed.has_ended).messages()
        ]
        assert read == [(topic, stamp_ns) for topic, stamp_ns, _ in followed.messages], seed


def test_messages_that_reach_the_disk_late_are_not_left_out(recorded: int):
    growing = Growing([1, recorded // 2, recorded // 2 + 6])
    late = growing.messages.pop(recorded // 4)
    growing.messages.insert(recorded // 2 + 3, late)
    with pytest.raises(RecorderError, match=r"messages came, \d+ in order"):
        list(GrowingEpisode(growing.episode, growing.has_ended).messages())


@pytest.mark.parametrize("changed", ["prompt", "start"])
def test_an_episode_that_is_replaced_meanwhile_is_converted_from_its_beginning(recorded: int, changed: str):
    growing = Growing([recorded // 2])
    if changed == "prompt":
        growing.found = {**growing.found, "metadata": {**growing.found["metadata"], "prompt": "another"}}
    else:
        growing.messages.insert(0, [*growing.messages[0][:1], growing.messages[0][1] - 1, growing.messages[0][2]])
    got = growing.unit(follow, growing.has_ended)
    assert got == growing.unit(stage)


def test_an_episode_that_records_who_commands_is_converted_once_it_has_ended(recorded: int):
    growing = Growing([recorded // 2, recorded // 2 + 5])
    stamp_ns = growing.messages[0][1]
    growing.found["topics"][COMMANDER] = String.ros_type
    growing.messages.insert(0, [COMMANDER, stamp_ns, "operator"])
    growing.has_ended(0.0)
    assert growing.unit(follow, growing.has_ended) == growing.unit(stage)


def test_following_ends_with_the_session(recorded: int):
    growing = Growing([recorded // 2])

    def died(timeout_s: float) -> bool:
        raise ComponentFailed("the session has ended")

    with pytest.raises(ComponentFailed, match="the session has ended"):
        growing.unit(follow, died)
    assert not [path for path in Path("set").rglob("*") if ".making." in path.name]
