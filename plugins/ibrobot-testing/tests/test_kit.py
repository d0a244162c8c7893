"""`ibrobot plugins new` writes packages that work: each is tested, checked and run as its author would do."""

from __future__ import annotations

import ast
import re
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
from ibrobot_kit.new import SAMPLE, NewPlugin, render
from new_packages import NewPackages, sample_kinds

from ibrobot_core.api import Descriptor, IbrobotError
from ibrobot_core.app import RequestError, installed_plugins, load_config

KINDS = sample_kinds("ibrobot-testing")
"""Those of core; tests/integration/test_new_plugins.py has those of plugins."""
ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> NewPackages:
    return NewPackages.of(tmp_path_factory.mktemp("packages"), KINDS)


def test_every_kind_of_core_has_a_sample() -> None:
    hooks = {f"ibrobot_{kind}s" for kind in KINDS} | {installed_plugins().all_kinds.get(kind, "") for kind in KINDS}
    text = (ROOT / "ibrobot_core/hookspecs.py").read_text()
    registering = {name for name in re.findall(r"^def (ibrobot_\w+)\(\) -> Iterable", text, re.MULTILINE)} - {
        "ibrobot_kinds",
        "ibrobot_doctor",
    }  # a kind of one's own is no kind, and checks stand beside something else
    assert registering - {"ibrobot_sources"} <= hooks  # whose sample offers a command, the way to a source


def test_tests_of_new_packages_pass(packages: NewPackages) -> None:
    done = packages.tests([kind for kind in KINDS if kind != "message" or find_spec("ibrobot_ros2")])  # it encodes
    assert done.returncode == 0, done.stdout


def test_new_packages_are_discovered_without_mistakes_and_their_robots_are_right(
    packages: NewPackages, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in KINDS:
        monkeypatch.syspath_prepend(str(packages.place(kind)))
    installed_plugins.cache_clear()
    registry = installed_plugins()
    installed_plugins.cache_clear()
    assert registry.failures == []
    for kind in KINDS:
        interface = "sensor" if kind == "camera" else kind
        if interface in registry.all_kinds and kind != "source":
            descriptor = registry.find(interface, f"my_{kind}")
            assert isinstance(descriptor, Descriptor)
            assert descriptor.summary
        for sim in (False, True):
            assert load_config(packages.robot(kind), sim=sim, registry=registry).robot.name == "tryout"


@pytest.mark.parametrize(
    "kind", [kind if kind in ("engine", "source") else pytest.param(kind, marks=pytest.mark.long) for kind in KINDS]
)
def test_robot_of_a_new_package_runs(packages: NewPackages, kind: str) -> None:
    if kind == "recorder" and find_spec("ibrobot_data") is None:
        pytest.skip("needs ibrobot-plugin-data, whose section uses recorders")
    done = packages.launch(kind, *(() if kind == "command" else ("--lockstep",)))
    assert done.returncode == 0, done.stderr
    assert ("faults     none" in done.stdout) == (kind != "command")


@pytest.mark.parametrize("kind", KINDS)
def test_every_name_in_a_new_package_is_defined_or_imported(kind: str) -> None:
    """A class that is cut out of its module brings what it needs, and nothing of the fakes is left."""
    for path, text in render(kind, "odd_one").items():
        if path.endswith(".py"):
            tree = ast.parse(text)
            statements = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom | ast.Import)]
            imported = {alias.asname or alias.name for node in statements for alias in node.names}
            used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
            assert imported - {"annotations"} <= used, path
            own = text.replace("FakeArm", "").replace("ibrobot_testing.fakes import FakeRecorder", "")
            assert "Fake" not in own.replace("FakeRecorder(host", ""), path
            assert max(len(line) for line in text.splitlines()) <= 120, path


def test_package_has_the_licence_of_ibrobot() -> None:
    files = render("teleop", "my_stick")
    assert files["LICENSE"] == (ROOT / "LICENSE").read_text(encoding="utf-8")
    project = tomllib.loads(files["pyproject.toml"])["project"]
    assert project["dependencies"][0] == "ibrobot-core>=0.1,<0.2"
    assert project["optional-dependencies"]["test"] == ["ibrobot-testing>=0.1,<0.2", "pytest>=8.3"]
    assert (project["license"], project["license-files"]) == ("Apache-2.0", ["LICENSE"])


def test_package_that_only_the_tests_need_need_not_be_installed() -> None:
    project = tomllib.loads(render("recorder", "another")["pyproject.toml"])["project"]
    assert "ibrobot-plugin-data>=0.1,<0.2" in project["optional-dependencies"]["test"]


@pytest.mark.parametrize("name", ["", "My_arm", "my-arm", "1st", "my arm", "../up", "ärm", "x_", "a__b"])
def test_name_that_no_module_can_have_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(RequestError, match=r"NAME is .*: use lower-case letters, digits and _, e.g. my_arm"):
        NewPlugin("teleop", name, tmp_path)()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["class", "none", "null", "no", "off", "on", "yes", "core", "testing"])
def test_name_that_is_taken_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(
        RequestError, match=r"that is (a word of Python or of YAML|ibrobot_\w+, which is installed); choose another"
    ):
        NewPlugin("teleop", name, tmp_path)()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("kind", "name"), [("executor", "plan"), ("executor", "executor"), ("policy", "frame")])
def test_name_that_the_package_itself_needs_is_an_error(tmp_path: Path, kind: str, name: str) -> None:
    with pytest.raises(
        RequestError, match=f"which the package needs for something else; choose another, e.g. my_{name}"
    ):
        NewPlugin(kind, name, tmp_path)()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("kind", "name", "package"),
    [
        ("executor", "position", "ibrobot-core"),
        ("hardware", "fake", "ibrobot-testing"),
        ("command", "launch", "ibrobot-core"),
        ("transport", "local", "ibrobot-core"),
    ],
)
def test_type_that_another_package_offers_is_an_error(tmp_path: Path, kind: str, name: str, package: str) -> None:
    with pytest.raises(
        RequestError, match=f"^NAME is '{name}': {package} has the {kind} already; choose another, e.g. my_{name}$"
    ):
        NewPlugin(kind, name, tmp_path)()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(find_spec("ibrobot_diagnose") is None, reason="needs ibrobot-plugin-diagnose")
def test_name_that_the_descriptor_refuses_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"^NAME is 'plan_dry': ibrobot-plugin-diagnose has a cause of this name"):
        NewPlugin("cause", "plan_dry", tmp_path)()
    assert list(tmp_path.iterdir()) == []


def test_unknown_kind_is_named_and_so_is_a_near_one(tmp_path: Path) -> None:
    with pytest.raises(IbrobotError, match=r"^KIND is 'telepo', did you mean 'teleop'\?$"):
        NewPlugin("telepo", "my_stick", tmp_path)()
    assert list(tmp_path.iterdir()) == []


def test_kind_of_a_missing_package_names_the_package(tmp_path: Path) -> None:
    if "planner" in installed_plugins().types(SAMPLE):
        pytest.skip("the package is installed")
    with pytest.raises(IbrobotError, match="ibrobot-plugin-planning"):
        NewPlugin("planner", "my_planner", tmp_path)()


def test_folder_that_exists_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "ibrobot-plugin-wave").mkdir()
    (tmp_path / "ibrobot-plugin-wave/mine.py").write_text("mine")
    with pytest.raises(RequestError, match="ibrobot-plugin-wave exists; choose another name, or move it away"):
        NewPlugin("teleop", "wave", tmp_path)()
    assert [path.name for path in (tmp_path / "ibrobot-plugin-wave").iterdir()] == ["mine.py"]


def test_folder_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "here").write_text("mine")
    with pytest.raises(RequestError, match=r"--out .*here: is not a folder"):
        NewPlugin("teleop", "wave", tmp_path / "here")()


def test_it_prints_the_command_that_runs_the_new_plugin(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new = NewPlugin("teleop", "my_stick", tmp_path)
    new.show(new())
    assert re.search(r"^then: `ibrobot launch my_stick\.yaml .*`$", capsys.readouterr().out, re.MULTILINE)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout of the repository, as far as `new` looks at it."""
    lists = ("pyproject.toml", "README.md", "README.zh.md", "plugins/ibrobot/pyproject.toml")
    for name in (*lists, "ibrobot_core/hookspecs.py"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes((ROOT / name).read_bytes())
    return tmp_path


def test_in_the_repository_it_enters_what_a_package_there_needs(checkout: Path) -> None:
    made = NewPlugin("teleop", "my_stick", checkout / "plugins")()
    assert made["entered"] == ["pyproject.toml", "plugins/ibrobot/pyproject.toml", "README.md", "README.zh.md"]
    sources = tomllib.loads((checkout / "pyproject.toml").read_text())["tool"]["uv"]["sources"]
    assert sources["ibrobot-plugin-my-stick"] == {"workspace": True}
    extras = tomllib.loads((checkout / "plugins/ibrobot/pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    assert "ibrobot-plugin-my-stick>=0.1,<0.2" in extras["all"]
    for page in ("README.md", "README.zh.md"):
        before, after = ((each / page).read_text().splitlines() for each in (ROOT, checkout))
        (added,) = [line for line in after if line not in before]
        assert added == "| `ibrobot-plugin-my-stick` | the teleop `my_stick` |"
        assert after[after.index(added) - 1].startswith("| `ibrobot-plugin-")
    package = checkout / "plugins/ibrobot-plugin-my-stick"
    settings = tomllib.loads((package / "pyproject.toml").read_text())
    assert set(settings["tool"]) == {"hatch"}, "the repository's own settings are for all"
    assert "optional-dependencies" not in settings["project"]
    assert not (package / ".github").exists()


def test_in_the_repository_it_prints_commands_for_its_folder(
    checkout: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(checkout / "plugins")
    new = NewPlugin("teleop", "my_stick")
    new.show(new())
    (first, then) = capsys.readouterr().out.splitlines()[-2:]
    assert first.startswith(f"next: cd {checkout} && uv sync ")
    assert then.startswith("then: uv run pytest plugins/ibrobot-plugin-my-stick/tests tests/")
    tests = [word for word in then.split() if word.startswith("tests/")]
    assert all((ROOT / each).is_file() for each in tests)


def test_repository_with_a_list_missing_is_left_as_it_is(checkout: Path) -> None:
    (checkout / "README.zh.md").write_text("# empty\n")
    before = (checkout / "pyproject.toml").read_text()
    with pytest.raises(RequestError, match=r"README.zh.md: has no list of packages"):
        NewPlugin("teleop", "my_stick", checkout / "plugins")()
    assert (checkout / "pyproject.toml").read_text() == before
    assert not (checkout / "plugins/ibrobot-plugin-my-stick").exists()
