"""Makes a ROS 2 Jazzy in a folder, from wheels: rclpy, Fast DDS, and the message types that have no wheels.

    python make_ros.py FOLDER

It is a virtual environment, for x86-64 only; a second call builds only types that have changed. Needs uv, CMake and a
C++ compiler.
"""

from __future__ import annotations

import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

INTERFACES = Path(__file__).parent / "interfaces"
LIBRARY = Path(__file__).parents[2] / "ibrobot-ros2" / "ibrobot_ros2"
PACKAGES = {
    "control_msgs": (
        (LIBRARY / "interfaces/control_msgs",),
        ("builtin_interfaces", "std_msgs", "sensor_msgs", "trajectory_msgs"),
    ),
    "tf2_msgs": ((INTERFACES / "tf2_msgs",), ("geometry_msgs",)),
    "ibrobot_msgs": (
        (LIBRARY / "msg", LIBRARY / "interfaces/ibrobot_msgs"),
        ("builtin_interfaces", "std_msgs", "geometry_msgs", "sensor_msgs"),
    ),
}
"""Package -> folders of its texts, and the packages that these need."""
WHEELS = [
    f"ros-jazzy-{name}"
    for name in (
        "rclpy", "rmw-implementation", "rmw-fastrtps-cpp", "std-msgs", "std-srvs", "sensor-msgs", "geometry-msgs",
        "trajectory-msgs", "diagnostic-msgs", "rosgraph-msgs", "action-msgs", "service-msgs", "unique-identifier-msgs",
        "type-description-interfaces", "tracetools", "ament-package", "ament-cmake", "ament-cmake-ros",
        "ament-cmake-include-directories", "ament-cmake-gmock", "ament-cmake-gtest", "ament-cmake-pytest",
        "python-cmake-module", "rosidl-default-generators", "rosidl-core-generators", "rosidl-default-runtime",
    )
]  # fmt: skip
TOOLS = ["numpy", "pyyaml", "lark", "empy==3.3.4", "catkin_pkg"]
BUILDER_PREFIX = "/opt/python/cp312-cp312"
"""Where the machine that built the wheels had Python: their CMake files name it."""
_DONE = "ibrobot-ros-made"
_MANIFEST = """<?xml version="1.0"?>
<package format="3">
  <name>{name}</name><version>0.0.0</version><description>Message types for tests.</description>
  <maintainer email="nobody@example.org">nobody</maintainer><license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  {depends}
  <member_of_group>rosidl_interface_packages</member_of_group>
</package>
"""
_BUILD = """cmake_minimum_required(VERSION 3.8)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{finds}
rosidl_generate_interfaces(${{PROJECT_NAME}} {files} DEPENDENCIES {needs})
ament_package()
"""


def missing() -> str:
    """Why this machine cannot have it; empty if it can."""
    if platform.machine() != "x86_64" or sys.platform != "linux":
        return f"rclpy has wheels for x86-64 Linux only, this is {platform.machine()} {sys.platform}"
    lacking = [name for name in ("uv", "cmake", "c++") if shutil.which(name) is None]
    return f"{', '.join(lacking)} not found, which the message types are built with" if lacking else ""


def environment(folder: Path) -> dict[str, str]:
    """The environment in which its programs run; nothing leaves this machine."""
    return {
        **os.environ,
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(folder),
        "CMAKE_PREFIX_PATH": str(folder),
        "LD_LIBRARY_PATH": str(folder / "lib"),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    }


def make(folder: Path) -> Path:
    """Make what is not there yet; returns its interpreter."""
    python = folder / "bin" / "python"
    if not (folder / _DONE).exists():
        subprocess.run(["uv", "venv", "--quiet", "--clear", "--python", "3.12", str(folder)], check=True)
        # Copies: `_mend` writes into files that would otherwise be those of uv's cache.
        install = ["uv", "pip", "install", "--quiet", "--link-mode", "copy", "--python", str(python)]
        subprocess.run([*install, *WHEELS, *TOOLS], check=True)
        _mend(folder, python)
        (folder / _DONE).touch()
    for name in PACKAGES:
        built, digest = folder / f"{_DONE}-{name}", digest_of(name)
        if not built.exists() or built.read_text(encoding="utf-8") != digest:
            _build(name, folder, python)
            built.write_text(digest, encoding="utf-8")
    return python


def digest_of(name: str) -> str:
    """What changes with the texts of a package."""
    text = b"".join(file.name.encode() + file.read_bytes() for file in _texts(name))
    return hashlib.sha256(text).hexdigest()


def _texts(name: str) -> list[Path]:
    """The files with the types of a package."""
    return sorted(each for folder in PACKAGES[name][0] for each in folder.rglob("*.*"))


def _mend(folder: Path, python: Path) -> None:
    """Have the CMake files of the wheels name this machine's folders."""
    ask = "import sysconfig, numpy; print(sysconfig.get_path('include')); print(numpy.get_include())"
    include, numpy = subprocess.run([str(python), "-c", ask], check=True, text=True, capture_output=True).stdout.split()
    named = re.compile(re.escape(BUILDER_PREFIX) + r"/lib/python3\.12/site-packages/numpy/_core/include")
    for file in (folder / "share").rglob("*.cmake"):
        text = file.read_text(encoding="utf-8")
        if BUILDER_PREFIX in text:
            text = named.sub(numpy, text).replace(f"{BUILDER_PREFIX}/include/python3.12", include)
            file.write_text(text, encoding="utf-8")


def _build(name: str, folder: Path, python: Path) -> None:
    needs = PACKAGES[name][1]
    with tempfile.TemporaryDirectory() as made:
        source = Path(made) / name
        files = []
        for text in _texts(name):
            kind = text.suffix.removeprefix(".")
            if kind in ("msg", "srv", "action"):
                files.append(f"{kind}/{text.name}")
                (source / kind).mkdir(parents=True, exist_ok=True)
                shutil.copy(text, source / kind)
        depends = "".join(f"<depend>{each}</depend>" for each in needs)
        (source / "package.xml").write_text(_MANIFEST.format(name=name, depends=depends), encoding="utf-8")
        finds = "\n".join(f"find_package({each} REQUIRED)" for each in needs)
        build = _BUILD.format(name=name, finds=finds, files=" ".join(files), needs=" ".join(needs))
        (source / "CMakeLists.txt").write_text(build, encoding="utf-8")
        flags = (
            "-Wno-dev",
            "-DBUILD_TESTING=OFF",
            f"-DCMAKE_INSTALL_PREFIX={folder}",
            f"-DPython3_EXECUTABLE={python}",
        )
        for command in (
            ["cmake", "-S", str(source), "-B", f"{made}/build", "-DCMAKE_BUILD_TYPE=Release", *flags],
            ["cmake", "--build", f"{made}/build", "--parallel", "2"],
            ["cmake", "--install", f"{made}/build"],
        ):
            done = subprocess.run(command, check=False, env=environment(folder), text=True, capture_output=True)
            if done.returncode:
                raise SystemExit(f"{name}: {' '.join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}")


if __name__ == "__main__":
    if reason := missing():
        print(reason)
        raise SystemExit(3)
    print(make(Path(sys.argv[1]).absolute()))
