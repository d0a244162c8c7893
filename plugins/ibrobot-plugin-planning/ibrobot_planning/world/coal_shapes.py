"""Shapes as objects of Coal."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import coal
import numpy as np

from ibrobot_core.api import Vector
from ibrobot_planning.world.objects import Box, Boxes, Capsule, Cylinder, Mesh, Plane, Shape, Sphere, Voxels

type Triangles = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


def geometry(shape: Shape) -> Any:
    """A coal.CollisionGeometry, in the frame of the shape; of several boxes, their convex hull."""
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
        case Boxes():
            made = hull(shape.corners.reshape(-1, 3))
    return made


def boxes(shape: Boxes) -> Iterator[tuple[Any, Vector]]:
    """Each as a coal.Box, and its placement in the frame of the shape, shape (4, 4)."""
    for size, (middle, *axes) in zip(shape.sizes.tolist(), shape.placements, strict=True):
        placed = np.eye(4)
        placed[:3, :3], placed[:3, 3] = np.transpose(axes), middle
        yield coal.Box(*size), placed


def convex(vertices: Vector, triangles: Triangles) -> Any:
    """A convex polytope with these corners and faces."""
    return coal.Convex(_points(vertices), _triangles(triangles))


def hull(points: Vector) -> Any:
    """The convex hull of points, shape (N, 3)."""
    return coal.Convex.convexHull(_points(points), False, None)


def convex_faces(points: Vector) -> tuple[Vector, Triangles]:
    """Corners of the convex hull of points, shape (N, 3), and its faces, as `Mesh` has them."""
    body = coal.Convex.convexHull(_points(points), True, None)
    faces = (body.polygons(number) for number in range(body.num_polygons))
    return np.array(body.points()), np.array([[face[corner] for corner in range(3)] for face in faces], dtype=np.intp)


def enclosing(shape: Any) -> Vector | None:
    """Points whose convex hull contains a convex shape of Coal, shape (N, 3); None for a shape that is not convex."""
    match shape:
        case coal.Box():
            half = shape.halfSide
        case coal.Sphere():
            half = np.full(3, shape.radius)
        case coal.Cylinder():
            half = np.array([shape.radius, shape.radius, shape.halfLength])
        case coal.Capsule():
            half = np.array([shape.radius, shape.radius, shape.halfLength + shape.radius])
        case coal.ConvexBase():
            return np.array(shape.points())
        case _:
            return None
    return np.array([(x, y, z) for x in (-half[0], half[0]) for y in (-half[1], half[1]) for z in (-half[2], half[2])])


def _mesh(mesh: Mesh) -> Any:
    if mesh.convex:
        return hull(mesh.vertices)
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
