"""Shapes as objects of Coal."""

from __future__ import annotations

from typing import Any

import coal
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_planning.world import Box, Capsule, Cylinder, Mesh, Plane, Shape, Sphere, Voxels

type Triangles = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def geometry(shape: Shape) -> Any:
    """A coal.CollisionGeometry, in the frame of the shape."""
    made: Any
    match shape:
        case Box():
            made = coal.Box(*shape.size)
        case Sphere():
            made = coal.Sphere(shape.radius)
        case Cylinder():
            made = coal.Cylinder(shape.radius, shape.height)
        case Capsule():
            made = coal.Capsule(shape.radius, shape.height)
        case Plane():
            made = coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)
        case Voxels():
            made = coal.makeOctree(shape.centres, shape.size)
        case Mesh():
            made = _mesh(shape)
    return made


def convex(vertices: Vector, triangles: Triangles) -> Any:
    """A convex polytope with these corners and faces."""
    return coal.Convex(_points(vertices), _triangles(triangles))


def _mesh(mesh: Mesh) -> Any:
    if mesh.convex:
        return coal.Convex.convexHull(_points(mesh.vertices), False, None)
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(mesh.triangles), len(mesh.vertices))
    model.addSubModel(_points(mesh.vertices), _triangles(mesh.triangles))
    model.endModel()
    return model


def _points(vertices: Vector) -> Any:
    points = coal.StdVec_Vec3s()
    for vertex in vertices:
        points.append(vertex)
    return points


def _triangles(triangles: Triangles) -> Any:
    listed = coal.StdVec_Triangle()
    for a, b, c in triangles.tolist():
        listed.append(coal.Triangle(a, b, c))
    return listed
