"""What the plugin registers, its options, and which OpenGL backend it takes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from ibrobot_mujoco import gl
from ibrobot_mujoco.experts.options import ExpertOptions
from ibrobot_mujoco.hardware import MujocoHardware
from ibrobot_mujoco.options import Fault, MujocoOptions, SceneCamera
from ibrobot_mujoco.scenes import scene
from ibrobot_mujoco.so101 import so101
from ibrobot_testing import control_context

from ibrobot_core.api import MissingDependency
from ibrobot_core.app import installed_plugins


def test_importing_the_plugin_imports_nothing_heavy() -> None:
    code = "import sys, ibrobot_mujoco; print(sorted({'mujoco', 'numpy', 'OpenGL'} & set(sys.modules)))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("kind", ["hardware", "scene", "sensor", "policy", "viewer"])
def test_is_found_by_discovery(kind: str) -> None:
    name = {"policy": "scripted_pick", "scene": "pick_cube"}.get(kind, "mujoco")
    assert installed_plugins().entries[kind, name].package == "ibrobot-plugin-mujoco"


def test_stands_for_the_robot_and_its_cameras() -> None:
    descriptor = installed_plugins().find("hardware", "mujoco")
    assert descriptor.simulated  # type: ignore[attr-defined]
    assert descriptor.sensors == {"camera": "mujoco"}  # type: ignore[attr-defined]
    assert isinstance(descriptor.make(MujocoOptions(), control_context(robot=so101())), MujocoHardware)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Fault(at=1.0, kind="freeze_joint"), "a fault of kind freeze_joint needs joint"),
        (lambda: Fault(at=1.0, kind="silent", joint="gripper"), "a fault of kind silent takes no joint"),
        (lambda: Fault(at=1.0, kind="explode"), "'explode' is not one of: silent, freeze_joint, read_error"),
        (
            lambda: scene(cube_distance=(0.3, 0.2)),
            r"\[0.3, 0.2\] is not a valid range: the first value must not exceed",
        ),
        (lambda: MujocoOptions(timestep=1.0), "1.0 is too large, must be at most 0.02 s"),
        (lambda: SceneCamera(name="c", pos=(0, 0, 1), lookat=(0, 0, 1)), "lookat must differ from pos"),
    ],
)
def test_options_refuse_what_makes_no_sense(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_egl_that_finds_no_driver_is_not_usable(tmp_path: Path) -> None:
    """As with the package libegl1 alone. Real libraries with an empty folder of drivers."""
    code = "from ibrobot_mujoco import gl; print(gl.usable())"
    environment = {"__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path), "PATH": ""}
    ran = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert "egl" not in ran.stdout


class TestOpenGl:
    """The choice of a backend, with the machine's libraries and display made up."""

    @pytest.fixture(autouse=True)
    def bare_machine(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(sys, "platform", "linux")
        self.have(monkeypatch)

    @staticmethod
    def have(monkeypatch: pytest.MonkeyPatch, *libraries: str, driver: bool = True) -> None:
        monkeypatch.setattr(gl, "_loads", lambda name: name in libraries)
        monkeypatch.setattr(gl, "_egl_has_a_driver", lambda: driver)

    def test_without_opengl_the_camera_names_the_packages_and_all_else_works(self) -> None:
        missing = installed_plugins().missing("sensor", "mujoco")
        assert missing is not None
        assert missing.remedy == "sudo apt-get install libegl1 libopengl0 libgl1-mesa-dri"
        with pytest.raises(MissingDependency, match=missing.remedy):
            gl.choose()
        assert installed_plugins().missing("hardware", "mujoco") is None
        assert installed_plugins().missing("policy", "scripted_pick") is None

    def test_egl_without_a_driver_cannot_render(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.have(monkeypatch, "libEGL.so.1", "libOpenGL.so.0", driver=False)
        assert gl.usable() == ()
        assert installed_plugins().missing("sensor", "mujoco") is not None

    def test_egl_comes_first(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.have(monkeypatch, "libEGL.so.1", "libGL.so.1", "libOSMesa.so.8")
        monkeypatch.setenv("DISPLAY", ":0")
        assert gl.usable() == ("egl", "osmesa", "glfw")
        assert gl.choose() == "egl"
        assert installed_plugins().missing("sensor", "mujoco") is None

    def test_egl_needs_opengl_too(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.have(monkeypatch, "libEGL.so.1", "libOSMesa.so.8")
        assert gl.choose() == "osmesa"

    def test_a_display_is_the_last_resort(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
        assert gl.choose() == "glfw"

    def test_the_environment_decides(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.have(monkeypatch, "libEGL.so.1", "libGL.so.1", "libOSMesa.so.8")
        monkeypatch.setenv("MUJOCO_GL", "OSMesa")
        assert gl.choose() == "osmesa"

    def test_a_backend_that_does_not_load_is_reported_before_mujoco_is_imported(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.have(monkeypatch, "libEGL.so.1", "libGL.so.1")
        monkeypatch.setenv("MUJOCO_GL", "osmesa")
        remedy = r"MUJOCO_GL=osmesa does not work on this machine \(or unset it\); sudo apt-get install libosmesa6"
        policy = installed_plugins().find("policy", "scripted_pick")
        with pytest.raises(MissingDependency, match=remedy):
            policy.make(ExpertOptions(), control_context("pick"))

    def test_an_unknown_backend_is_refused(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("MUJOCO_GL", "vulkan")
        with pytest.raises(MissingDependency, match=r"MUJOCO_GL is 'vulkan'.*; set it to one of egl, osmesa, glfw, or"):
            gl.choose()
