"""Worlds: immutable, and strict about what they are given."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from ibrobot_planning.world.objects import Box, Capsule, Cylinder, Mesh, Sphere, Voxels, World, WorldObject, read_mesh

from ibrobot_core.api import PlanCode, PlanningError, Pose, Quaternion, Vector3

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
ONE = np.array([[0, 1, 2]])
BLOCK = np.array([[x, y, z] for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)])
PLATE = BLOCK * [1, 1, 2e-8]
"""Coal ends the process when it makes its convex hull."""

MALFORMED = {
    "box with two lengths": (lambda: Box((1.0, 2.0)), r"size is \[1.0, 2.0\], must be three lengths"),
    "box without height": (lambda: Box((1.0, 1.0, 0.0)), "three lengths above 0"),
    "box in millimetres": (lambda: Box((400.0, 300.0, 20.0)), "at most 100 m"),
    "box that is nan": (lambda: Box((math.nan, 1.0, 1.0)), "three lengths above 0"),
    "sphere without radius": (lambda: Sphere(0.0), "radius is 0.0 m, must be above 0"),
    "sphere turned inside out": (lambda: Sphere(-0.1), "radius is -0.1 m"),
    "cylinder that is nan": (lambda: Cylinder(0.1, math.nan), "height is nan m"),
    "cylinder in millimetres": (lambda: Cylinder(30.0, 120.0), "height is 120.0 m, must be above 0 and at most 100 m"),
    "capsule without end": (lambda: Capsule(0.1, math.inf), "height is inf m"),
    "mesh of two corners": (lambda: Mesh(TRIANGLE[:2], ONE), r"vertices have shape \(2, 3\)"),
    "mesh in a plane": (lambda: Mesh(TRIANGLE[:, :2], ONE), r"vertices have shape \(3, 2\)"),
    "mesh that is nan": (lambda: Mesh(TRIANGLE * np.nan, ONE), "vertices must be finite"),
    "mesh without triangles": (lambda: Mesh(TRIANGLE, ONE[:0]), r"triangles have shape \(0, 3\)"),
    "mesh of quadrangles": (lambda: Mesh(TRIANGLE, np.array([[0, 1, 2, 0]])), r"triangles have shape \(1, 4\)"),
    "mesh of fractions": (lambda: Mesh(TRIANGLE, ONE * 1.0), "triangles are float64, must be whole numbers"),
    "mesh with a corner too many": (lambda: Mesh(TRIANGLE, ONE + 1), "a triangle names vertex 3; there are 3"),
    "mesh without area": (lambda: Mesh(TRIANGLE * [1, 0, 0], ONE), "the mesh has no area"),
    "mesh in millimetres": (lambda: Mesh(TRIANGLE * 400, ONE), "400 m across; for millimetres give scale: 0.001"),
    "flat hull": (lambda: Mesh(TRIANGLE, ONE, convex=True), "a flat mesh has no convex hull"),
    "hull that is flat but for rounding": (lambda: Mesh(PLATE, ONE, convex=True), "a flat mesh has no convex hull"),
    "hull that is flat but for rounding, far away": (
        lambda: Mesh(BLOCK + 1e9, ONE, convex=True),
        "a flat mesh has no convex hull",
    ),
    "voxels without cells": (lambda: Voxels(0.01, np.zeros((0, 3), int)), r"cells have shape \(0, 3\)"),
    "voxels between cells": (lambda: Voxels(0.01, np.zeros((1, 3))), "cells are float64, must be whole numbers"),
    "voxels without size": (lambda: Voxels(0.0, np.zeros((1, 3), int)), "size is 0.0 m"),
    "pose that is nan": (lambda: WorldObject(Sphere(0.1), Pose(Vector3(math.nan, 0, 0))), "the pose must be finite"),
    "quaternion of no length": (
        lambda: WorldObject(Sphere(0.1), Pose(orientation=Quaternion(0, 0, 0, 0))),
        "a quaternion of length 0, must be 1",
    ),
}


@pytest.mark.parametrize(("make", "message"), MALFORMED.values(), ids=MALFORMED)
def test_malformed_objects_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


CAN = WorldObject(Cylinder(0.03, 0.1), Pose(Vector3(0.2, 0, 0.05)))
WORLD = World({"can": CAN, "ball": WorldObject(Sphere(0.02))})
REFUSED = {
    "taken name": (lambda: WORLD.add("can", CAN), "there is an object 'can' already"),
    "no name": (lambda: WORLD.add("", CAN), "an object needs a name"),
    "unknown object to remove": (lambda: WORLD.remove("cup"), "no object 'cup'; the objects are: can, ball"),
    "unknown object to move": (lambda: WORLD.move("cup", Pose()), "no object 'cup'"),
    "unknown object to attach": (lambda: World().attach("cup", "hand", Pose()), "the objects are: none"),
    "object attached twice": (
        lambda: WORLD.attach("can", "hand", Pose()).attach("can", "hand", Pose()),
        "'can' is attached to 'hand' already",
    ),
    "object that is not attached": (lambda: WORLD.detach("can", Pose()), "object 'can' is not attached"),
}


@pytest.mark.parametrize(("change", "message"), REFUSED.values(), ids=REFUSED)
def test_impossible_changes_are_refused(change, message):
    with pytest.raises(PlanningError, match=message) as caught:
        change()
    assert caught.value.code is PlanCode.INVALID_OBJECT_NAME


def test_changes_make_new_worlds():
    attached = WORLD.attach("can", "hand", Pose(Vector3(0, 0, 0.05)), frozenset({"finger"}))
    assert WORLD.objects["can"] == CAN
    assert attached.objects["can"].link == "hand"
    assert attached.objects["can"].may_touch == {"hand", "finger"}
    put = attached.detach("can", CAN.pose)
    assert put.objects["can"] == CAN
    assert set(WORLD.remove("ball").objects) == {"can"}
    assert WORLD.move("ball", CAN.pose).objects["ball"].pose == CAN.pose


STL = """solid a
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 30 0 0
vertex 0 40 0
endloop
endfacet
endsolid a
"""


def test_meshes_are_read_from_files(tmp_path):
    path = tmp_path / "part.stl"
    path.write_text(STL)
    mesh = read_mesh(path, 0.001)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [0.03, 0.04, 0.0])
    assert mesh.triangles.shape == (1, 3)


TRIANGLE_STL = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
HEAD = b"\0" * 80
MESHES = {
    "empty": ("part.stl", b"", "File is empty"),
    "bytes": ("part.stl", bytes(range(256)), "Failed to determine STL storage representation"),
    "text": ("part.stl", b"not a mesh\n", "Failed to determine STL storage representation"),
    "cut off": (
        "part.stl",
        HEAD + struct.pack("<I", 9) + TRIANGLE_STL,
        "Failed to determine STL storage representation",
    ),
    "no triangles": ("part.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "No meshes remaining"),
    "corner that is missing": ("part.obj", b"v 0 0 0\nv 1 0 0\nf 1 2 9\n", "OBJ: vertex index out of range"),
    "another format": ("part.txt", b"v", "No suitable reader found for the file format of file; use STL, OBJ or PLY"),
    "damaged head": ("part.ply", b"ply\n", "Invalid .ply file"),
}


@pytest.mark.parametrize(("name", "data", "told"), MESHES.values(), ids=MESHES)
def test_unreadable_mesh_files_are_refused_with_the_reason(tmp_path, name: str, data: bytes, told: str):
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ValueError) as failure:
        read_mesh(path)
    message = str(failure.value)
    assert message.startswith(f"{path} cannot be read as a mesh: {told}")
    assert "Hint" not in message


def test_mesh_files_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no file .*cup.stl"):
        read_mesh(tmp_path / "cup.stl")
    broken = tmp_path / "broken.stl"
    broken.write_bytes(b"\0" * 100)
    with pytest.raises(ValueError, match=r"broken.stl"):
        read_mesh(broken)
    large = tmp_path / "large.stl"
    large.write_text(STL.replace("30", "300").replace("40", "4000"))
    with pytest.raises(ValueError, match=r"large.stl: the mesh is 4000 m across; for millimetres give scale: 0.001"):
        read_mesh(large)
    with pytest.raises(ValueError, match=r"scale is 0, must be above 0"):
        read_mesh(large, 0)
