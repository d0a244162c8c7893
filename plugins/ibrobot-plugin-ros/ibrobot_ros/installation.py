"""Where the ROS of this machine is, and how its interpreter is started."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

import attrs

from ibrobot_core.api import MissingDependency, how_to_install
from ibrobot_ros.options import RosInstallation

DISTROS = Path("/opt/ros")
PREFERRED = "jazzy"
REMEDY = (
    "source a ROS 2 (. /opt/ros/jazzy/setup.bash), or set ros.python or ros.setup; on x86-64 with Python 3.12 "
    f"`{how_to_install('ros-jazzy-rclpy', 'ros-jazzy-rmw-fastrtps-cpp')}` brings one without an installation"
)
_PROFILES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS, the new one and that of Humble, reads its settings from; other middleware ignores them."""


@attrs.frozen
class Interpreter:
    """An interpreter that has rclpy."""

    command: tuple[str, ...]
    """Command that runs a script; the arguments follow."""
    found: str
    """How it was found."""
    environment: Mapping[str, str] = attrs.field(factory=dict)
    """Variables that the packages beside it need."""


def find_interpreter(options: RosInstallation) -> Interpreter:
    """The interpreter of the options, or that of the ROS of this machine.

    Raises:
        MissingDependency: if there is none.
    """
    if options.setup is not None:
        if not options.setup.is_file():
            raise MissingDependency(f"ros.setup: no such file: {options.setup}", remedy=REMEDY)
        return _sourced(options.setup, options.python or "python3", "ros.setup")
    if options.python is not None:
        python = shutil.which(options.python)
        if python is None:
            raise MissingDependency(f"ros.python: no such program: {options.python}", remedy=REMEDY)
        return Interpreter((python,), "ros.python", beside(python))
    if find_spec("rclpy") is not None:
        return Interpreter((sys.executable,), "the interpreter of ibrobot", beside(sys.executable))
    if os.environ.get("AMENT_PREFIX_PATH") and (python := shutil.which("python3")) is not None:
        return Interpreter((python,), "the sourced ROS")
    for setup in sorted(DISTROS.glob("*/setup.bash"), key=lambda path: path.parent.name != PREFERRED):
        return _sourced(setup, "python3", str(setup))
    raise MissingDependency("no ROS 2 was found", remedy=REMEDY)


def _sourced(setup: Path, python: str, program: str) -> Interpreter:
    """The interpreter of an environment that a script sets up."""
    script = 'set +u; . "$0" && exec "$@"'
    return Interpreter(("bash", "-c", script, str(setup), python), program)


def beside(python: str) -> dict[str, str]:
    """The variables of ROS packages that are installed beside an interpreter, as from wheels."""
    # A virtual environment's interpreter is a link: its packages are beside the link.
    prefix = Path(python).absolute().parent.parent
    if not (prefix / "share/ament_index").is_dir():
        return {}
    variables = {}
    for name, folder in (("AMENT_PREFIX_PATH", prefix), ("LD_LIBRARY_PATH", prefix / "lib")):
        others = [each for each in os.environ.get(name, "").split(os.pathsep) if each and Path(each) != folder]
        variables[name] = os.pathsep.join([str(folder), *others])
    return variables


def environment(options: RosInstallation, interpreter: Interpreter) -> dict[str, str]:
    """The environment of the node."""
    variables = {**os.environ, **interpreter.environment}
    if options.domain is not None:
        variables["ROS_DOMAIN_ID"] = str(options.domain)
    if options.discovery != "system_default":
        variables["ROS_AUTOMATIC_DISCOVERY_RANGE"] = options.discovery.upper()
        variables.pop("ROS_LOCALHOST_ONLY", None)
        if options.discovery == "localhost":
            variables.pop("ROS_STATIC_PEERS", None)
    if options.rmw is not None:
        variables["RMW_IMPLEMENTATION"] = options.rmw
    if not any(name in variables for name in (*_PROFILES, "FASTDDS_BUILTIN_TRANSPORTS")):
        variables |= dict.fromkeys(_PROFILES, str(Path(__file__).with_name("fast_dds.xml")))
    return variables
