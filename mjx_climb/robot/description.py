"""A robot's own MJCF or URDF as its author wrote it, without what the dynamics do not need."""

import re
from pathlib import Path

from mjx_climb.mujoco_import import mujoco

JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))


class RobotError(ValueError):
    """A model that mjx_climb cannot use: the message names the model and what was expected."""


def bare(file: str) -> mujoco.MjSpec:
    """Return the description in a file without shapes of weighed bodies, looks, actuators and sensors.

    A URDF has its inertias written down, and so have many an MJCF's bodies: their shapes, and the files of meshes, do
    not matter. Moments of inertia that no body can have are mended as MuJoCo mends them (`balanceinertia`).

    Raises:
        ValueError: a file that MuJoCo does not read.
    """
    spec = mujoco.MjSpec.from_file(file)
    urdf = file.lower().endswith(".urdf")
    for part in (*spec.actuators, *spec.sensors, *spec.pairs, *spec.excludes, *spec.skins):
        spec.delete(part)
    from_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in spec.geoms:
        weighed = urdf or (geom.parent.explicitinertial and not from_shapes) or geom.parent.name == "world"
        if weighed or geom.mass == 0 or geom.density == 0:
            spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for geom in spec.geoms:
        geom.material = ""
    for part in (*(mesh for mesh in spec.meshes if mesh.name not in used), *spec.materials, *spec.textures):
        spec.delete(part)
    spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True
    return spec


def line_of(file: str, name: str) -> str:
    """Return a file, and after a colon the line in which it first names an element so, if it does."""
    try:
        text = Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return file
    found = re.search(rf"name\s*=\s*[\"']{re.escape(name)}[\"']", text)
    return f"{file}:{text.count(chr(10), 0, found.start()) + 1}" if found else file
