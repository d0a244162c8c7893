"""Every check of this repository: `nox` runs all side by side, `nox -l` lists them, `nox -s core` runs one."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import json
import os
import re
import resource
import shlex
import shutil
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import nox
from nox.command import CommandFailed
from packaging.requirements import Requirement

nox.needs_version = ">=2026.8.10"
nox.options.default_venv_backend = "uv"
nox.options.reuse_venv = "yes"
# `nox` alone runs sessions side by side, one more than there are cores since tests wait too, and prints each one's
# output when it ends. They start in the order of this file: the longest come first, then those that wait most, and last
# those that keep the cores busy together. A named session prints as it runs. `-j` says otherwise.
nox.options.allow_parallel = True
nox.options.parallel = 1 if sys.argv[1:] else (os.cpu_count() or 1) + 1
# The many processes that tests start would otherwise compile what they import, each for itself.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# More threads than one gain nothing beside other sessions: torch's and NumPy's wait for one another by spinning.
os.environ.setdefault("OMP_NUM_THREADS", "1")

PROJECT = nox.project.load_toml("pyproject.toml")
FOLDERS = {
    path.parent.name.removeprefix("ibrobot-").removeprefix("plugin-"): path.parent
    for path in sorted(Path("plugins").glob("*-*/pyproject.toml"))  # a folder of a package that went may be left
}
"""Name -> folder, of every plugin, of the libraries that they share, and of what LeRobot discovers."""
SLOW = ("feetech", "testing", "data", "mcap")
PLUGINS = sorted(FOLDERS, key=lambda name: (name not in SLOW, name))
"""Those whose tests take longest come first."""
TESTED = [name for name in PLUGINS if (FOLDERS[name] / "tests").is_dir()]
"""Those with tests of their own; the others have theirs in tests/lerobot."""
LOCAL = {
    "ibrobot-core": Path(),
    "ibrobot": Path("plugins/ibrobot"),
    **{folder.name: folder for folder in FOLDERS.values()},
}
"""Distribution -> folder."""
EXAMPLES = {"ibrobot-plugin-jointlog": Path("tests/examples/ibrobot-plugin-jointlog")}
"""As `LOCAL`, of what tests install and nobody publishes."""
EXTRAS = {
    "ibrobot-gym": "[inspect]",
    "ibrobot-plugin-camera": "[realsense]",
    "ibrobot-plugin-lerobot": "[hub]",
    "ibrobot-plugin-mcap": "[plot]",
    "ibrobot-plugin-mujoco": "[urdf]",
    "ibrobot-plugin-planning": "[client,obstacles,plot]",
    "ibrobot-plugin-policy-servers": "[grpc]",
    "ibrobot-plugin-zenoh": "[interop]",
}
"""Distribution -> extras that its tests use."""
_VERSIONS = Path("plugins/ibrobot-plugin-lerobot/ibrobot_lerobot/versions.py").read_text(encoding="utf-8")
LEROBOT_VERSIONS = re.findall(r'^    "(\d+\.\d+\.\d+)": ', _VERSIONS, re.MULTILINE)
"""The tested versions of LeRobot, oldest first."""
THIRD_PARTIES = ("lerobot-robot-dummy==1.0.1", "lerobot-robot-lekiwi-pincopen==0.1.2")
"""Packages of others that add robots to LeRobot; these run without their device, or name what they lack."""
PLATFORMS = ("x86_64-unknown-linux-gnu", "aarch64-unknown-linux-gnu", "aarch64-apple-darwin")
"""Where everything must install without a compiler: PCs, robots' own computers (e.g. Jetson), and Macs."""
# A fixed seed: the same checks give the same result; `nox -s core -- --hypothesis-seed=random` explores.
# A test that fails runs once more: beside other sessions, processes that tests start may be late. `RERUN` lists it.
PYTEST = ("pytest", "--config-file=pyproject.toml", "--rootdir=.", "--hypothesis-seed=0", "--reruns=1", "-rfEsR")
TWO = ("-n", "2", "--dist", "worksteal")
"""Two tests at once: in sessions so long that the others would end before them."""
UNTYPED = (
    "disallow_untyped_defs",
    "disallow_incomplete_defs",
    "disallow_untyped_calls",
    "disallow_untyped_decorators",
    "warn_return_any",
)
"""Tests need no annotations; what has them is checked, and so is what is in functions without."""
NAMED = os.environ.setdefault("NOX_NAMED", "yes" if sys.argv[1:] else "")
"""Whether a person asked for certain sessions, and not for all side by side."""
SHORT = "" if NAMED else " and not long"
"""In all sessions side by side, the tests that are marked `long` are left to those that are asked for by name."""
IS_FIRST = "NOX_NOT_TESTED" not in os.environ
"""Whether this process started the others: those that run one session each, side by side."""
NOT_TESTED = Path(os.environ.setdefault("NOX_NOT_TESTED", str(Path(f".nox/not-tested-{os.getpid()}").absolute())))
"""The file of what no session could test on this machine, and what to do about it."""
PROCESSOR = Path(os.environ.setdefault("NOX_PROCESSOR", str(Path(f".nox/processor-{os.getpid()}").absolute())))
"""The file with the processor time of each session."""
BYTECODE = Path(".nox/bytecode").absolute()
"""What Python compiled of installed packages, for all environments."""
if not IS_FIRST and "integration" not in sys.argv:
    # All others end beside the longest one if they leave the processor to it. Linux shares the processor among the
    # sessions of processes first, and each of nox is one.
    os.nice(5)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("5", encoding="ascii")


def packages(*requirements: str, plain: tuple[str, ...] = ()) -> list[str]:
    """Install arguments for `requirements`: what is in this repository as it is here, with what of it that needs.

    The distributions `plain` come without their extras.
    """
    folders = LOCAL | EXAMPLES
    local: list[str] = []
    wanted = list(map(Requirement, requirements))
    for each in wanted:  # it grows meanwhile
        if each.name in folders and each.name not in local:
            local.append(each.name)
            project = nox.project.load_toml(folders[each.name] / "pyproject.toml")["project"]
            wanted += map(Requirement, project["dependencies"])
    asked = [str(each) for each in wanted[: len(requirements)] if each.name not in folders]
    extras = {name: extra for name, extra in EXTRAS.items() if name not in plain}
    local.remove("ibrobot-core")  # all need it: uv finds it in the workspace, and builds it once for all sessions
    return [*(argument for name in local for argument in ("-e", f"{folders[name]}{extras.get(name, '')}")), *asked]


def share_bytecode(environment: Path) -> None:
    """Let an environment use what Python compiled in others of the same packages, and leave there what it compiles.

    Python recognizes it by the time and size of the source: uv links that to one file in all environments.
    """
    for packages in environment.glob("lib/python*/site-packages"):
        for folder, _, files in os.walk(packages):
            source = next((name for name in files if name.endswith(".py")), None)
            if source and Path(folder, source).stat().st_nlink > 1:  # a copy of its own has a time of its own
                shared = BYTECODE / Path(folder).relative_to(packages)
                shared.mkdir(parents=True, exist_ok=True)
                with contextlib.suppress(FileExistsError):
                    Path(folder, "__pycache__").symlink_to(shared)


def install(
    session: nox.Session, *plugins: str, groups: tuple[str, ...] = ("test",), options: tuple[str, ...] = (),
    plain: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Install core, some plugins and some dependency groups; distributions that are `plain` without their extras."""
    distributions = ("ibrobot-core", *(FOLDERS[name].name for name in plugins))
    groups_need = nox.project.dependency_groups(PROJECT, *groups)
    session.install("-c", "constraints.txt", *options, *packages(*distributions, *groups_need, plain=plain))
    share_bytecode(Path(session.virtualenv.location))


def lacking(session: nox.Session, python: str) -> list[dict[str, Any]]:
    """The types installed for `python` that lack something on this machine."""
    rows: list[dict[str, Any]] = json.loads(
        str(session.run(python, "tests/house/lacking.py", silent=True, external=True))
    )
    return rows


def apt_install(session: nox.Session, *wanted: str) -> bool:
    """Install Debian packages, where root runs this; returns whether it could."""
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        return False
    session.run("apt-get", "update", "-qq", external=True)
    session.run("apt-get", "install", "-qq", "-y", *wanted, external=True)
    return True


def note_untested(session: nox.Session, line: str) -> None:
    """Report what a session does not test, now and after all sessions."""
    session.warn(line)
    with NOT_TESTED.open("a", encoding="utf-8") as file:
        file.write(f"{session.name}: {line}\n")


def chromium(session: nox.Session) -> None:
    """Check for Chromium, which tests of web pages need: root installs it; they are skipped without it."""
    with Path(".nox/apt.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        present = {"chromium": shutil.which("chromium"), "libatomic1": find_library("atomic")}  # for Playwright
        wanted = [package for package, found in present.items() if not found]
        if wanted and not apt_install(session, *wanted):
            note_untested(session, f"web pages are not tested: apt-get install {' '.join(wanted)}")


def system_libraries(session: nox.Session, python: str = "python") -> set[str]:
    """Check for the system libraries that installed types lack: root installs them, anybody else gets the command.

    Tests that need what stays missing are skipped. Returns the kinds of the types that lack something.
    """
    with Path(".nox/apt.lock").open("w") as lock:  # one session at a time; the next one finds them installed
        fcntl.flock(lock, fcntl.LOCK_EX)
        found = lacking(session, python)
        wanted = sorted({package for row in found for package in row["apt"]})
        if wanted and apt_install(session, *wanted):
            found = lacking(session, python)
    for row in found:
        note_untested(session, f"{row['kind']} {row['type']} is not tested: {row['what']}; {row['remedy']}")
    return {row["kind"] for row in found}


def skip_without_libraries(session: nox.Session) -> None:
    """End a session of which nearly all tests need what this machine lacks."""
    note_untested(session, "none of its tests runs: many need these libraries")
    session.skip("it lacks libraries")


@atexit.register
def list_what_was_not_tested() -> None:
    """After all sessions."""
    if IS_FIRST and NOT_TESTED.exists():
        for line in NOT_TESTED.read_text(encoding="utf-8").splitlines():
            print(f"nox > {line}", file=sys.stderr)
        NOT_TESTED.unlink()


@atexit.register
def list_processor_time() -> None:
    """After all sessions: the processor time of each, with its environment and all processes that it started."""
    used = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    if not IS_FIRST:
        name = next(sys.argv[i + 1] for i, each in enumerate(sys.argv) if each in ("-s", "--session", "--sessions"))
        with PROCESSOR.open("a", encoding="utf-8") as file:
            file.write(f"{used:.0f} {name}\n")
    elif PROCESSOR.exists():
        each = sorted(map(str.split, PROCESSOR.read_text(encoding="utf-8").splitlines()), key=lambda row: -int(row[0]))
        listed = ", ".join(f"{name} {seconds}" for seconds, name in each)
        print(f"nox > processor: {used:.0f} s in all; {listed}", file=sys.stderr)
        PROCESSOR.unlink()


def installation(page: str) -> list[str]:
    """What the first `$ pip install` of a page's console blocks installs, and the commands after it in that block."""
    text = Path(page).read_text(encoding="utf-8")
    begins = r"^```console\n\$ pip install (?:--find-links dist )?\"?(ibrobot\S*?)\"?\n(.*?)^```"
    block = re.search(begins, text, re.MULTILINE | re.DOTALL)
    if block is None:
        raise ValueError(f"{page}: no console block begins with `$ pip install ibrobot…`")
    return [block[1], *re.findall(r"^\$ (.*)$", block[2], re.MULTILINE)]


def marked(mark: str) -> list[str]:
    """The files with tests of `mark`: each process that collects all of them takes seconds."""
    files = (*Path("tests").rglob("test_*.py"), *Path("plugins").glob("*/tests/**/test_*.py"))
    return sorted(str(file) for file in files if f"mark.{mark}" in file.read_text(encoding="utf-8"))


@nox.session
def integration(session: nox.Session) -> None:
    """What needs several plugins."""
    install(session, *PLUGINS, groups=("test", "browser", "agents", "examples"))
    if "guard" in system_libraries(session):  # every launched robot has one
        skip_without_libraries(session)
    chromium(session)
    session.run(*PYTEST, *TWO, "-m", f"integration{SHORT}", *marked("integration"), *session.posargs)


@nox.session(default=False)
def minimums(session: nox.Session) -> None:
    """Core's and the plugins' tests with the oldest versions that they allow; not one of `nox` alone: it doubles that.

    Every test of code runs, with few examples of Hypothesis: the search for rare ones is that of the other sessions.
    """
    install(session, *PLUGINS, options=("--resolution=lowest-direct", "-e", "."))  # core's requirements are direct, too
    system_libraries(session)
    few = ("--hypothesis-profile=few", "-m", "not integration and not lerobot and not long")
    # These read files, or break devices on purpose, whatever the versions; suites run in the tests of all plugins.
    alike = ("tests/house", "tests/docs", "plugins/ibrobot-testing/tests")
    ignored = (f"--ignore={folder}" for folder in alike)
    session.run(*PYTEST, *TWO, *few, *ignored, "tests", "plugins", *session.posargs)


@nox.session
def lerobot(session: nox.Session) -> None:
    """LeRobot itself, unmodified, against what the plugins offer; the one session with torch."""
    extras = "async,damiao,dataset,diffusion,dynamixel,evaluation,feetech,rebot,smolvla,training"
    lerobot = f"lerobot[{extras}]=={LEROBOT_VERSIONS[-1]}"
    install(session, *PLUGINS, options=(lerobot, "onnxscript"))  # the latter exports policies
    # Beside the environment: LeRobot imports them wherever it runs, with torch.
    others = Path(session.create_tmp()).absolute() / "third_parties"
    session.install("--no-deps", "--target", str(others), *THIRD_PARTIES)
    if system_libraries(session):
        skip_without_libraries(session)
    folder = {"IBROBOT_THIRD_PARTIES": str(others)}
    session.run(*PYTEST, "-m", f"lerobot{SHORT}", *marked("lerobot"), *session.posargs, env=folder)


@nox.session(default=False)
@nox.parametrize("version", [*LEROBOT_VERSIONS, "newest"], ids=[*LEROBOT_VERSIONS, "newest"])
def lerobot_versions(session: nox.Session, version: str) -> None:
    """Another version of LeRobot: its datasets, its loading of ours, its checkpoints, and its devices."""
    extras = "dataset,training,diffusion,feetech" if version >= "0.6" else "feetech"
    pinned = "" if version == "newest" else f"=={version}"
    is_old = version < "0.5"  # it needs an older library for the Hub, and does not say that NumPy must be older
    plain, more = (("ibrobot-plugin-lerobot",), ("numpy<2.3",)) if is_old else ((), ())
    install(session, *PLUGINS, options=(f"lerobot[{extras}]{pinned}", *more), plain=plain)
    system_libraries(session)
    tests = [f"tests/lerobot/test_{name}.py" for name in ("recorded", "dataset", "policy", "feetech_bus", "devices")]
    report = Path(session.create_tmp()).absolute() / "report.xml"
    # What it warns of is its own.
    session.run(*PYTEST, "-W", "default", "-m", "lerobot", f"--junitxml={report}", *(session.posargs or tests))
    if pinned and not session.posargs:
        session.run("python", "tests/lerobot/versions_page.py", version, str(report))


def run_again(session: nox.Session, *command: str) -> None:
    """Run a command, and once more if it fails, as tests do: beside other sessions, a run in real time may be late.

    A simulation then runs in lockstep, which does not depend on the other sessions.
    """
    try:
        session.run(*command, external=True)
    except CommandFailed:
        print("RERUN", shlex.join(command), flush=True)
        session.run(*command, *(("--lockstep",) if "--sim" in command else ()), external=True)


def check_wheels(session: nox.Session, folder: Path) -> None:
    """What the wheels in `folder / "dist"` install runs by itself, as the pages say; environments land in `folder`."""
    for page in ("README.md", "plugins/ibrobot-plugin-feetech/README.md"):
        requirement, *commands = installation(page)
        environment = folder / requirement
        session.run("uv", "venv", "--quiet", "--clear", str(environment))
        # Wheels of an earlier run have the same names.
        fresh = (f"--refresh-package={name}" for name in LOCAL)
        wheels = ("--find-links", str(folder / "dist"), "-c", "constraints.txt", *fresh)
        session.run("uv", "pip", "install", "--quiet", "--python", str(environment), *wheels, requirement)
        share_bytecode(environment)
        lacks = system_libraries(session, str(environment / "bin/python"))
        with session.chdir(folder):  # away from this repository
            for command in commands:
                program, *arguments = shlex.split(command, comments=True)
                if arguments[:1] == ["record"] and lacks:  # a recording needs its cameras
                    note_untested(session, f"`{command}` is not run: it needs these libraries")
                    continue
                run_again(session, str(environment / "bin" / program), *arguments)
    emulated = Path("tests/house/launch_on_emulators.py").absolute()
    with session.chdir(folder):
        run_again(session, "python", str(emulated), str(folder / "ibrobot-plugin-feetech/bin/ibrobot"))


@nox.session
def wheels(session: nox.Session) -> None:
    """Whether everything, with all extras, installs from wheels on each platform; what is installed runs by itself."""
    projects = [str(folder / "pyproject.toml") for folder in LOCAL.values()]
    options = ("--quiet", "--all-extras", "-c", "constraints.txt", "--only-binary", ":all:", "--python-version", "3.12")
    for platform in PLATFORMS:
        session.run("uv", "pip", "compile", *options, "--python-platform", platform, "-o", os.devnull, *projects)
    folder = Path(session.create_tmp()).absolute()
    session.run("uv", "build", "--quiet", "--all-packages", "--wheel", "--out-dir", str(folder / "dist"))
    check_wheels(session, folder)


@nox.session(default=False)
def kit(session: nox.Session) -> None:
    """`ibrobot plugins new` for each kind, or `-- KIND …`: from wheels, in an empty environment, until its robot runs.

    Prints lines and seconds of each kind. Not one of `nox` alone: it makes an environment for each.
    """
    folder = Path(session.create_tmp()).absolute()
    for each in ("dist", "packages"):
        shutil.rmtree(folder / each, ignore_errors=True)
    session.run("uv", "build", "--quiet", "--all-packages", "--wheel", "--out-dir", str(folder / "dist"))
    session.run("python", "tests/house/new_plugins.py", str(folder / "dist"), str(folder), *session.posargs)


@nox.session(default=False)
def mutants(session: nox.Session) -> None:
    """Mutants of what `ibrobot plugins new` writes, of all kinds or `-- KIND …`: which do tests let pass, and why?"""
    offers = json.loads(Path("ibrobot_core/official_plugins.json").read_text(encoding="utf-8"))
    folders = {folder.name: name for name, folder in FOLDERS.items()}
    owners = [folders[package] for package, each in offers.items() if "sample" in each]
    install(session, *owners, "ros2", options=("mutmut>=3.8,<4",))  # whose encoder the tests of messages need
    folder = Path(session.create_tmp()).absolute()
    os.nice(19)  # it has time
    session.run("python", "tests/house/mutants.py", str(folder), *session.posargs)


@nox.session(default=False)
def release(session: nox.Session) -> None:
    """A version from its number to checked wheels: `-- X.Y.Z`. Uploads nothing; CONTRIBUTING.md says what follows."""
    session.install("towncrier", "twine")
    session.run("python", "tests/house/set_version.py", *session.posargs)
    if f"\n## {session.posargs[0]}\n" not in Path("CHANGELOG.md").read_text(encoding="utf-8"):
        session.run("towncrier", "build", "--yes", "--version", session.posargs[0])
    folder = Path(session.create_tmp()).absolute()
    shutil.rmtree(folder / "dist", ignore_errors=True)
    session.run("uv", "build", "--quiet", "--all-packages", "--out-dir", str(folder / "dist"))
    session.run("twine", "check", "--strict", *map(str, sorted((folder / "dist").glob("*-*"))))
    check_wheels(session, folder)
    session.run("git", "commit", "--quiet", "--all", "-m", f"Version {session.posargs[0]}", external=True)
    session.run("git", "tag", f"v{session.posargs[0]}", external=True)
    session.log(f"committed and tagged; the files are in {folder / 'dist'}")


@nox.session
@nox.parametrize("name", TESTED, ids=TESTED)
def plugin(session: nox.Session, name: str) -> None:
    """A plugin's tests with that plugin and core alone; those in a browser run in `integration`."""
    install(session, name, groups=("test", "coverage"))
    if "guard" in system_libraries(session):  # planners and guards are all that its package is
        skip_without_libraries(session)
    # A report without a threshold shows code that the package's own tests do not reach. It takes half as long again.
    measured = (f"--cov=ibrobot_{name.replace('-', '_')}", "--cov-report=term:skip-covered") if NAMED else ()
    chosen = () if NAMED else ("-m", "not long")
    session.run(*PYTEST, *chosen, *measured, str(FOLDERS[name] / "tests"), *session.posargs)


@nox.session
def core(session: nox.Session) -> None:
    """Core's tests with no plugin installed."""
    install(session)
    session.run(*PYTEST, "-m", "not integration and not lerobot", "tests", *session.posargs)


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation: every warning is an error, every example runs."""
    install(session, *PLUGINS, groups=("docs", "test"))
    build = ("sphinx-build", "-q", "-W", "--keep-going", "-n", "-d", "docs/_build/doctrees")  # read once for both
    session.run(*build, "-b", "html", "docs", "docs/_build/html")
    session.run(*build, "-t", "read", "-b", "doctest", "docs", "docs/_build/doctest")
    session.log(f"the site is at {Path('docs/_build/html/index.html').absolute().as_uri()}")


@nox.session
def types(session: nox.Session) -> None:
    """Types of core and of every plugin, strictly, and of all tests, benchmarks and scripts of the documentation."""
    install(session, *PLUGINS, groups=("docs", "lint", "test", "browser", "agents"))
    folder = Path(session.create_tmp()).absolute()
    shared = (
        "tests/shared",
        "tests/house",
        "tests/lerobot",
        "benchmarks",
        "docs",
        "plugins/ibrobot-plugin-lerobot/tests",
        *(str(folder / "tests") for folder in EXAMPLES.values()),
    )
    untyped = ["tests.*"]
    for module in {path.stem for each in shared for path in Path(each).iterdir() if path.suffix in (".py", "")}:
        untyped += [module, f"{module}.*"] if module.isidentifier() else []
    # One run, so that mypy reads everything once. All plugins have a package `tests`: here each has another name.
    packages_of_tests = {name: f"{name.replace('-', '_')}_tests" for name in TESTED}
    for name, package in packages_of_tests.items():
        (folder / package).unlink(missing_ok=True)
        (folder / package).symlink_to((FOLDERS[name] / "tests").absolute())
        untyped.append(f"{package}.*")
    options = "".join(f"{option} = false\n" for option in UNTYPED)
    config = Path("pyproject.toml").read_text(encoding="utf-8")
    config += f"\n[[tool.mypy.overrides]]\nmodule = {json.dumps(sorted(untyped))}\n{options}"
    (folder / "pyproject.toml").write_text(config, encoding="utf-8")
    typed = ("ibrobot_core", *(str(path.parent) for path in sorted(Path("plugins").glob("*/*/py.typed"))))
    tests = (
        "tests",
        "benchmarks",
        *map(str, Path("docs").glob("*.py")),
        *(str(folder / package) for package in packages_of_tests.values()),
    )
    bases = {"MYPYPATH": ":".join((*shared, *map(str, FOLDERS.values()), str(folder)))}
    given = (f"--config-file={folder / 'pyproject.toml'}", "--explicit-package-bases")
    session.run("mypy", *given, *typed, *tests, env=bases)


@nox.session
def layers(session: nox.Session) -> None:
    """Which module may import which: the contracts in tests/house/imports.toml."""
    session.install("-c", "constraints.txt", *nox.project.dependency_groups(PROJECT, "lint"))
    session.run("python", "tests/house/lint_imports.py", env={"PYTHONPATH": ":".join(map(str, LOCAL.values()))})


@nox.session
def lint(session: nox.Session) -> None:
    """Style, formatting, docstrings."""
    session.install("-c", "constraints.txt", *nox.project.dependency_groups(PROJECT, "lint"))
    session.run("ruff", "check", "--no-cache", ".")
    session.run("ruff", "format", "--no-cache", "--check", ".")


@nox.session(default=False)
def ros(session: nox.Session) -> None:
    """A run beside a real ROS 2 Jazzy: rclpy and Fast DDS from wheels, which only x86-64 Linux has.

    Its full counts, e.g. of goals, take IBROBOT_ROS_SHARE=1; without it a tenth.
    """
    tests = FOLDERS["ros"] / "tests"
    folder = Path(session.create_tmp()).absolute() / "jazzy"
    install(session, "ros", "planning", "mcap", "data", "zenoh")
    made = session.run("python", str(tests / "make_ros.py"), str(folder), silent=True, success_codes=[0, 3])
    if not (folder / "bin/python").exists():
        note_untested(session, f"ROS 2 is not tested: {str(made).strip()}")
        return
    python = {"IBROBOT_ROS_PYTHON": str(folder / "bin/python")}
    session.run(*PYTEST, str(tests / "with_ros"), *session.posargs, env=python)


@nox.session(default=False, venv_backend="none")
def fresh(session: nox.Session) -> None:
    """README's first two commands on a minimal Debian with nothing installed; or others: `-- [-u] COMMAND…`."""
    lines = Path("README.md").read_text(encoding="utf-8").splitlines()
    commands = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")][:2]
    session.run("tests/fresh/fresh.sh", *(session.posargs or commands), external=True)
