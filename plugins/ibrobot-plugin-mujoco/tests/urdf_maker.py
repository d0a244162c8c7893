"""Makes URDFs of arms, and files around them, in many variants."""

from __future__ import annotations

import struct
from itertools import product
from pathlib import Path

INERTIAL = (
    '<inertial><origin xyz="0 0 0.06"/><mass value="{mass}"/>'
    '<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>'
)
BOX = '<box size="0.04 0.04 0.1"/>'
FACES = "0 1 3 0 3 2 4 6 7 4 7 5 0 4 5 0 5 1 2 3 7 2 7 6 0 2 6 0 6 4 1 5 7 1 7 3"
"""The triangles of a box, by its corners."""
LIMIT = '<limit lower="-2" upper="2" effort="40" velocity="2"/>'


def link(name: str, shape: str = BOX, *, mass: float = 0.5, inertia: float = 1e-3, tag: str = "collision") -> str:
    """A link of 12 cm."""
    solid = INERTIAL.format(mass=mass, i=inertia) if mass else ""
    body = f'<{tag}><origin xyz="0 0 0.06"/><geometry>{shape}</geometry></{tag}>' if shape else ""
    return f'<link name="{name}">{solid}{body}</link>\n'


def joint(
    name: str, parent: str, child: str, *, type: str = "revolute", xyz: str = "0 0 0.13", axis: str = "0 1 0",
    inside: str = LIMIT,
) -> str:  # fmt: skip
    """A joint."""
    return (
        f'<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}"/><axis xyz="{axis}"/>{inside}</joint>\n'
    )


def chain(count: int, parent: str, pattern: str, *, xyz: str = "0 0 0.13", fingers: int = 0) -> str:
    """Joints one after another, named by a pattern with {}; with fingers at the end."""
    text, above = "", parent
    for i in range(1, count + 1):
        child = "link_" + pattern.format(i)
        text += link(child) + joint(pattern.format(i), above, child, xyz=xyz, axis="0 0 1" if i % 2 else "0 1 0")
        above, xyz = child, "0 0 0.13"
    for i in range(fingers):
        child = f"finger_{pattern.format(i)}"
        limit = '<limit lower="0" upper="0.03" effort="20" velocity="0.2"/>'
        at, axis = (("0.05 0 0.15", "1 0 0"), ("-0.05 0 0.15", "-1 0 0"))[i]
        text += link(child, '<box size="0.01 0.01 0.02"/>', mass=0.05, inertia=1e-5)
        text += joint(f"finger_{pattern.format(i)}", above, child, type="prismatic", xyz=at, axis=axis, inside=limit)
    return text


def robot(body: str, name: str = "made") -> str:
    """A URDF."""
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n<link name="base"/>\n{body}</robot>\n'


def arm(count: int, pattern: str = "joint_{}", *, fingers: int = 0) -> str:
    """A URDF of one arm."""
    return robot(chain(count, "base", pattern, fingers=fingers))


ARMS = {
    "prefixes": ("left_joint_{}", "right_joint_{}"),
    "suffixes": ("yumi_joint_{}_l", "yumi_joint_{}_r"),
    "first letters": ("l_arm_{}_joint", "r_arm_{}_joint"),
    "numbers": ("panda_1_joint{}", "panda_2_joint{}"),
    "without a word": ("joint_{}0", "joint_{}1"),
    "four fingers": ("index_{}", "middle_{}", "ring_{}", "thumb_{}"),
    "dots": ("joint_{}.0", "joint_{}.1", "joint_{}.2", "joint_{}.3"),
}
"""How the joints of several arms are named."""
SEVERAL = list(product(ARMS, (3, 4, 7, 8), (0, 1, 2), (0, 1, 3)))
"""Naming, joints of each arm, fingers of each, joints of the torso."""


def several(naming: str, count: int, fingers: int, torso: int) -> str:
    """A URDF of several arms, on a torso."""
    text = chain(torso, "base", "torso_{}")
    above = f"link_torso_{torso}" if torso else "base"
    for i, pattern in enumerate(ARMS[naming]):
        text += chain(count, above, pattern, xyz=f"0 {0.4 * i - 0.3:g} 0.1", fingers=fingers)
    return robot(text)


def collada(size: tuple[float, float, float], unit: str = "") -> str:
    """A box as a Collada file."""
    x, y, z = (each / 2 for each in size)
    corners = " ".join(f"{a} {b} {c}" for a, b, c in product((-x, x), (-y, y), (-z, z)))
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>
<created>2024-01-01T00:00:00</created>
<modified>2024-01-01T00:00:00</modified>{unit}<up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g" name="g"><mesh><source id="p">
<float_array id="a" count="24">{corners}</float_array>
<technique_common><accessor source="#a" count="8" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/>
</vertices><triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/>
<p>{FACES}</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="s"><node id="n"><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


_FACES = FACES.split()


def write_stl(path: Path, size: tuple[float, float, float], *, ascii: bool = False) -> None:
    """A box as an STL file."""
    corners = list(product(*((-each / 2, each / 2) for each in size)))
    faces = [[corners[int(each)] for each in _FACES[i : i + 3]] for i in range(0, 36, 3)]
    if ascii:
        text = "".join(
            "facet normal 0 0 0\nouter loop\n"
            + "".join(f"vertex {x} {y} {z}\n" for x, y, z in face)
            + "endloop\nendfacet\n"
            for face in faces
        )
        path.write_text(f"solid box\n{text}endsolid box\n")
        return
    data = b"".join(struct.pack("<12fH", 0, 0, 0, *(v for corner in face for v in corner), 0) for face in faces)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", 12) + data)
