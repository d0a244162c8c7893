"""Take the meshes of a URDF into the folder of a model: found, converted where MuJoCo cannot read them, in metres."""

from __future__ import annotations

import re
import shutil
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import attrs
import mujoco

from ibrobot_core.api import HardwareError, how_to_install
from ibrobot_mujoco.ros_packages import Packages
from ibrobot_mujoco.urdf_file import Shape, several

_READS = (".stl", ".obj", ".msh")
"""Meshes that MuJoCo reads."""
_FLAT = ("coplanar", "at least 4 vertices")
"""MuJoCo's error for a mesh without a volume."""
_INSTALL = how_to_install("ibrobot-plugin-mujoco[urdf]")


@attrs.define
class Meshes:
    """The meshes of one model."""

    folder: Path
    packages: Packages
    _files: dict[Path, str] = attrs.field(factory=dict)
    _names: dict[tuple[str, tuple[float, ...]], str] = attrs.field(factory=dict)
    _converted: list[str] = attrs.field(factory=list)
    _scaled: list[str] = attrs.field(factory=list)
    _flat: list[str] = attrs.field(factory=list)

    def take(self, spec: mujoco.MjSpec, shape: Shape, link: str) -> str | None:
        """Add the mesh of a shape to the model; returns its name, or None if it is flat.

        Raises:
            HardwareError: if it does not exist or cannot be read, or is too small.
        """
        source = self._find(shape, link)
        if source not in self._files:
            self._files[source] = self._copy(source, shape, link)
        file = self._files[source]
        if (file, shape.size) in self._names:
            return self._names[file, shape.size]
        if fault := self._fault(file, shape):
            if any(text in fault for text in _FLAT):
                self._flat.append(source.name)
                return None
            scale = " ".join(f"{each:g}" for each in shape.size)
            raise HardwareError(
                f"{shape.place}: link {link!r}: the mesh {source} with scale {scale} cannot be used: {fault}"
            )
        name = f"{Path(file).stem}_{len(self._names)}"
        spec.add_mesh(name=name, file=file, scale=shape.size, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
        self._names[file, shape.size] = name
        return name

    def notes(self) -> list[str]:
        """Notes on what was changed."""
        texts = (
            ("Meshes that MuJoCo does not read are converted to STL: {}.", self._converted),
            ("Meshes in other units are converted to metres, as their files say: {}.", self._scaled),
            ("Flat meshes have no volume and are left out: {}.", self._flat),
        )
        notes = [text.format(several(list(dict.fromkeys(names)))) for text, names in texts if names]
        return [*notes, *(["The shapes are the convex hulls of the URDF's collision meshes."] if self._files else [])]

    def _find(self, shape: Shape, link: str) -> Path:
        name, at = unquote(shape.mesh), f"{shape.place}: link {link!r}"
        scheme, separator, rest = name.partition("://")
        if not separator:
            path = Path(name)
        elif scheme == "file":
            path = Path(rest)
        elif scheme in ("package", "model"):
            package, _, inside = rest.partition("/")
            try:
                path = self.packages.find(package) / inside
            except HardwareError as error:
                raise HardwareError(f"{at}: {error}") from None
        else:
            raise HardwareError(
                f"{at}: the mesh {name} is not a file of this machine: download it, and change filename"
            )
        path = self.packages.file.parent / path
        try:
            exists = path.is_file()
        except (OSError, ValueError):
            exists = False
        if not exists:
            raise HardwareError(f"{at} has the mesh {path}, which does not exist")
        return path

    def _copy(self, source: Path, shape: Shape, link: str) -> str:
        stem = f"{len(self._files):02d}_{re.sub(r'[^A-Za-z0-9_.-]', '_', source.stem)}"
        suffix = source.suffix.lower()
        try:
            if suffix in _READS:
                name = f"{stem}{suffix}"
                shutil.copyfile(source, self.folder / name)
                if suffix != ".stl" or "stl_decoder" not in (self._fault(name, shape) or ""):
                    return name
                (self.folder / name).unlink()  # ASCII, or with more triangles than MuJoCo reads
            _convert(source, self.folder / f"{stem}.stl", self._scaled)
        except OSError as error:
            raise HardwareError(f"{shape.place}: link {link!r}: the mesh {source}: {error.strerror}") from error
        except HardwareError as error:
            raise HardwareError(f"{shape.place}: link {link!r}: {error}") from error
        self._converted.append(source.name)
        return f"{stem}.stl"

    def _fault(self, file: str, shape: Shape) -> str | None:
        """Why MuJoCo cannot use a mesh."""
        spec = mujoco.MjSpec()
        spec.add_mesh(
            name="mesh",
            file=str((self.folder / file).absolute()),
            scale=shape.size,
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
        )
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
        try:
            spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            return str(error).removeprefix("Error: ").partition("\n")[0].partition(" . Try")[0]
        return None


def _convert(source: Path, target: Path, scaled: list[str]) -> None:
    try:
        import trimesh
        from trimesh.units import unit_conversion
    except ImportError:
        raise HardwareError(f"{source} must be converted to STL: {_INSTALL}") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of NumPy, for the reader of .dae
            mesh: Any = trimesh.load(str(source), force="mesh")
        factor = unit_conversion(mesh.units, "meters") if mesh.units else 1.0
        if not 0 < factor < 1e4:
            raise ValueError(f"its unit is {mesh.units}")
        if abs(factor - 1) > 1e-9:
            mesh.apply_scale(factor)
            scaled.append(f"{source.name} ({mesh.units})")
        if not len(mesh.faces):
            raise ValueError("it has no triangles")
        mesh.export(str(target))
    except Exception as error:  # trimesh raises the errors of many readers
        text = " ".join(str(error).split()) or type(error).__name__
        raise HardwareError(f"the mesh {source} cannot be converted to STL: {text}") from error
