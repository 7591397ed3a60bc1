"""A robot's own MJCF or URDF as its author wrote it, without the parts that the dynamics do not need."""

import collections
import os
import re
import warnings
from collections.abc import Collection
from pathlib import Path

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.reading import check_regular
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.markup import (
    check_names,
    check_numbers,
    fixed_by_limits,
    is_urdf,
    line_of,
    lines_of,
    needed,
    text_of,
)

JOINTS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
SPECK = 1e-10  # kg, of links without a mass, as many a file has them between two joints
SPECK_MOMENT = 1e-14  # kg m^2, of these and of points: MuJoCo wants some, and an insect's leg has 1e-11
ROWS, COLUMNS = (0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)  # of an inertia, as MuJoCo writes it in a row
_POINT = 1e-9  # rad or m, either way, of a joint whose two limits are one: MuJoCo wants a range
_ROUNDING = 1e-6  # of the largest moment of inertia
_POSITIONS = {int(mujoco.mjtJoint.mjJNT_FREE): 7, int(mujoco.mjtJoint.mjJNT_BALL): 4}  # in a keyframe; of others 1
TURNED = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)  # by an actuator: a joint
_OF_ACTUATORS = ("gaintype", "gainprm", "biastype", "forcerange", "forcelimited", "ctrlrange", "ctrllimited")
_SIZES = {  # numbers that a plain shape's size has, and how many where its ends are given
    mujoco.mjtGeom.mjGEOM_SPHERE: (1, 1),
    mujoco.mjtGeom.mjGEOM_CAPSULE: (2, 1),
    mujoco.mjtGeom.mjGEOM_CYLINDER: (2, 1),
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: (3, 2),
    mujoco.mjtGeom.mjGEOM_BOX: (3, 2),
}
_NUMBER = re.compile(r"[Ll]ine (?:number=)?(\d+)")
_DROPPED = ("actuators", "sensors", "pairs", "excludes", "skins", "tendons", "cameras", "lights", "flexes", "hfields")


def described(file: str, looks: bool = False) -> mujoco.MjSpec:
    """Return the description in a file, with a name for every body and joint and hinges in place of ball joints.

    A body without a name is called after its parent and its place among the children, a joint after its body. A ball
    joint `hip` becomes hinges `hip_x`, `hip_y`, `hip_z` about the body's own axes. Visual parts of a URDF
    are left out, unless with `looks`.

    Raises:
        RobotError: a file that MuJoCo does not read, or numbers that no joint and no body can have.
    """
    spec = _read(file, looks)
    _check_numbers(file, spec)
    for part in (*spec.bodies, *spec.joints, *spec.sites):
        if part.name and not part.name.isprintable():
            raise RobotError(f"{line_of(file, part.name)}: expected a name of one printable line, got {part.name!r}")
    free, ball = mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL
    bodies, joints = ({part.name for part in parts} for parts in (spec.bodies, spec.joints))
    for body in spec.bodies:
        parts = [(child, f"{body.name}_{number + 1}", bodies) for number, child in enumerate(body.bodies)]
        parts += [(joint, body.name + "_free" * (joint.type == free), joints) for joint in body.joints]
        for part, name, taken in parts:
            if not part.name:
                while name in taken:
                    name += "_"
                part.name = name
                taken.add(name)
    for joint in [joint for joint in spec.joints if joint.type == ball]:
        _as_hinges(spec, joint)
    fixed = fixed_by_limits(file)
    for joint in spec.joints:
        if joint.type in JOINTS and joint.name in fixed:
            joint.range = fixed[joint.name] + np.array([-_POINT, _POINT])
            # MuJoCo 4 takes equal limits for none
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    return spec


def _read(file: str, looks: bool) -> mujoco.MjSpec:
    if not file.endswith((".xml", ".urdf")):
        raise RobotError(f"{file}: expected a file whose name ends in .xml or .urdf")
    try:
        check_regular(file)
    except FileNotFoundError:  # MuJoCo says so
        pass
    except OSError as error:
        raise RobotError(f"{file}: expected an MJCF or URDF, got {error.strerror}") from None
    text = text_of(file)
    if macro := re.search(r"<xacro:\w+", text):
        place = f"{file}:{text.count(chr(10), 0, macro.start()) + 1}"
        raise RobotError(f"{place}: expected a URDF that xacro has written out, got {macro[0]}>")
    check_numbers(file)
    check_names(file)
    mujoco.set_mju_user_warning(lambda message: None)  # the error that is raised says it once
    try:
        if is_urdf(file):
            text, visible = needed(text), '<mujoco><compiler discardvisual="false"/></mujoco>'
            if looks and "<mujoco" not in text:
                text = re.sub(r"(<robot\b[^>]*>)", rf"\1{visible}", text, count=1)
            spec = mujoco.MjSpec.from_string(text)
        else:
            spec = mujoco.MjSpec.from_file(file)
        for part in (*spec.bodies, *spec.joints, *spec.sites, *spec.keys, *spec.actuators):
            part.name  # noqa: B018, decoded as it is read
        return spec
    except UnicodeDecodeError as error:
        place = line_of(file, error.object.decode("utf-8", "replace"))
        raise RobotError(f"{place}: expected names in UTF-8, got {error.object!r}") from None
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise _unreadable(file, error) from None
    finally:
        mujoco.set_mju_user_warning(None)


def _check_numbers(file: str, spec: mujoco.MjSpec) -> None:
    """Refuse numbers and names that MuJoCo misreads or ignores.

    Those are limits the wrong way round (for none), a mass below zero (for none), numbers that are none, a drive of a
    joint that is not there (its own compiler, which would refuse it, sees no drives here).
    """
    urdf = is_urdf(file)
    for joint in spec.joints:
        lower, upper = joint.range
        limited = urdf or joint.limited != mujoco.mjtLimited.mjLIMITED_FALSE
        wrong = [
            (not np.isfinite([lower, upper]).all(), "finite limits, or none", f"{lower:g} to {upper:g}"),
            (lower > upper and limited, "limits in ascending order", f"{lower:g} to {upper:g}"),
        ]
        for name in ("armature", "damping", "stiffness", "frictionloss"):
            value = np.ravel(getattr(joint, name))[0]  # of polynomials the linear part
            wrong.append((not 0 <= value < np.inf, f"{name} of zero or more", f"{value:g}"))
        for bad, expected, got in wrong:
            if bad:
                raise RobotError(f"{line_of(file, joint.name)}: joint {joint.name!r}: expected {expected}, got {got}")
    for body in spec.bodies:
        full = np.array(body.fullinertia)  # begins with nan where it is not given
        given = [body.mass, *(full if np.isfinite(full[0]) or full[1:].any() else body.inertia)]
        if body.explicitinertial and (not np.isfinite(given).all() or body.mass < 0 or min(body.inertia) < 0):
            got = f"{given[0]:g} kg, {', '.join(f'{moment:g}' for moment in given[1:])} kg m^2"
            place = f"{line_of(file, body.name)}: link {body.name!r}"
            raise RobotError(f"{place}: expected a mass and moments of zero or more, got {got}")
    known = {joint.name for joint in spec.joints}
    for actuator in spec.actuators:
        if actuator.trntype in TURNED and actuator.target not in known:
            place = line_of(file, actuator.target)
            raise RobotError(f"{place}: expected actuators of joints in the file, got one of {actuator.target!r}")


def _as_hinges(spec: mujoco.MjSpec, ball: mujoco.MjsJoint) -> None:
    for actuator in [each for each in spec.actuators if each.trntype in TURNED and each.target == ball.name]:
        own = {key: getattr(actuator, key) for key in _OF_ACTUATORS}
        for letter, gear in zip("xyz", actuator.gear[:3], strict=True):
            if gear:
                target = {"trntype": mujoco.mjtTrn.mjTRN_JOINT, "target": f"{ball.name}_{letter}"}
                spec.add_actuator(**target, gear=[gear, 0, 0, 0, 0, 0], **own)
        spec.delete(actuator)
    own = {key: getattr(ball, key) for key in ("pos", "stiffness", "damping", "armature", "limited")}
    if (limit := float(ball.range[1])) > 0:
        own["range"] = [-limit, limit]
    name, parent = ball.name, ball.parent
    spec.delete(ball)
    for letter, axis in zip("xyz", np.eye(3), strict=True):
        parent.add_joint(name=f"{name}_{letter}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, **own)


def bare(file: str, shaped: Collection[str] = ()) -> mujoco.MjSpec:
    """Return the description in a file without shapes of weighed bodies, looks, actuators, sensors and tendons.

    A URDF has its inertias written down, and so have many an MJCF's bodies: their shapes, and the files of meshes, do
    not matter. Plain shapes stay, without a mass: they tell where a limb ends. Moments of inertia that no body can have
    are made equal, as MuJoCo does (`balanceinertia`), and links without a mass get a speck of one. Keyframes that are
    not as long as the robot has positions are left out. Bodies in `shaped` keep the meshes that are there, and their
    visual parts.

    Raises:
        RobotError: a file that MuJoCo does not read.
    """
    spec = described(file, looks=bool(shaped))
    _limit_torques(spec)
    tendons = [each for each in spec.equalities if each.type == mujoco.mjtEq.mjEQ_TENDON]
    for part in [*tendons, *(part for kind in _DROPPED for part in getattr(spec, kind))]:
        spec.delete(part)
    positions = sum(_POSITIONS.get(int(joint.type), 1) for joint in spec.joints)
    for key in spec.keys:
        key.ctrl, key.act = [], []
        if len(key.qpos) not in (0, positions):  # MuJoCo would fill up the rest
            spec.delete(key)
    for body in spec.bodies:
        _mend(body)
    _drop_shapes(file, spec, shaped)
    spec.compiler.fusestatic = False
    spec.compiler.boundmass = max(spec.compiler.boundmass, SPECK)
    spec.compiler.boundinertia = max(spec.compiler.boundinertia, SPECK_MOMENT)
    return spec


def _drop_shapes(file: str, spec: mujoco.MjSpec, shaped: Collection[str]) -> None:
    meshes = {mesh.name: _found_mesh(file, spec, mesh.file) for mesh in spec.meshes} if shaped else {}
    urdf, (lowest, highest) = is_urdf(file), spec.compiler.inertiagrouprange
    from_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in spec.geoms:
        geom.material = ""
        in_world = geom.parent.name == "world"
        weighed = urdf or (geom.parent.explicitinertial and not from_shapes) or in_world
        if not weighed and geom.mass != 0 and geom.density != 0 and lowest <= geom.group <= highest:
            continue
        meant = geom.parent.name in shaped and meshes.get(geom.meshname) is not None
        whole, between = _SIZES.get(geom.type, (0, 0))  # of a plain shape, which stays where all of its sizes are given
        sizes = np.array(geom.size[: between if np.isfinite(geom.fromto).all() else whole])
        plain = whole and not geom.meshname and (sizes > 0).all()
        if in_world or not (plain or meant):
            spec.delete(geom)
        else:
            geom.mass = 0
    for site in spec.sites:
        site.material = ""
    used = {geom.meshname for geom in spec.geoms}
    for mesh in spec.meshes:
        if mesh.name not in used:
            spec.delete(mesh)
        elif path := meshes.get(mesh.name):
            mesh.file, mesh.inertia = path, mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # one that need not be closed
    for part in (*spec.materials, *spec.textures):
        spec.delete(part)


def _found_mesh(file: str, spec: mujoco.MjSpec, mesh: str) -> str | None:
    """Return the path of a mesh: beside the file, in its folder of meshes, or around it in a ROS package; or None."""
    folder, name = Path(file).absolute().parent, re.sub(r"^(package|file|model)://", "", mesh)
    inside = name.partition("/")[2]  # the package
    places = [folder / name, folder / spec.meshdir / name, folder / spec.meshdir / Path(name).name]
    places += [around / path for around in folder.parents[:3] for path in (name, inside)] if inside else []
    readable = Path(mesh).suffix.lower() in (".stl", ".obj", ".msh")
    return next((str(path) for path in places if readable and path.is_file()), None)


def files_of(file: Path) -> set[Path]:
    """The absolute paths that MuJoCo may read an MJCF from: the file, its includes, its meshes and other assets.

    It looks for an asset in the folders of meshes beside the file and beside each include, with and without the folders
    of its name; some of these paths may not be there.
    """
    file = Path(os.path.abspath(file))
    named = [Path(os.path.normpath(file.parent / other)) for other in mujoco.mju_getXMLDependencies(str(file))]
    texts = {file, *(each for each in named if each.suffix.lower() == ".xml")}
    read = {*texts}
    for asset in (each for each in named if each not in texts):
        beside = {os.path.normpath(each.parent / os.path.relpath(asset, file.parent)) for each in texts}
        read |= {folder / asset.name for each in beside for folder in Path(each).parents} | set(map(Path, beside))
    return read


def impossible(body: mujoco.MjsBody) -> bool:
    """Return whether no body can have these moments of inertia: a principal one is above the sum of the others."""
    moments = _moments(body)
    least, middle, most = np.linalg.eigvalsh(moments)
    return bool(most > SPECK_MOMENT and np.diag(moments).min() >= 0 and least + middle < (1 - _ROUNDING) * most)


def _mend(body: mujoco.MjsBody) -> None:
    """Make impossible moments equal, and raise those of points, rods and plates to the least that MuJoCo takes."""
    if not body.explicitinertial:
        return
    moments = _moments(body)
    least, middle, most = np.linalg.eigvalsh(moments)
    if np.abs(moments).max() <= SPECK_MOMENT:
        moments = SPECK_MOMENT * np.eye(3)
    elif impossible(body):
        moments = np.eye(3) * np.trace(moments) / 3
    elif least >= -_ROUNDING * most and (least <= 0 or least + middle < most):
        moments = moments + 2 * _ROUNDING * most * np.eye(3)
    if np.isfinite(body.fullinertia[0]):
        body.fullinertia = moments[ROWS, COLUMNS]
    else:
        body.inertia = np.diag(moments)


def _moments(body: mujoco.MjsBody) -> np.ndarray:
    """Return the written inertia of a body, (3, 3) kg m^2; zeros where there is none."""
    matrix = np.diag(body.inertia)
    if np.isfinite(body.fullinertia[0]):
        matrix[ROWS, COLUMNS] = matrix[COLUMNS, ROWS] = body.fullinertia
    return matrix if body.explicitinertial and np.isfinite(matrix).all() else np.zeros((3, 3))


def _limit_torques(spec: mujoco.MjSpec) -> None:
    """Write the summed limits of the actuators into the joints that they turn, where these have none."""
    most: dict[str, float] = collections.defaultdict(float)
    off = mujoco.mjtLimited.mjLIMITED_FALSE
    for actuator in (each for each in spec.actuators if each.trntype in TURNED):
        force, control = np.array(actuator.forcerange), np.array(actuator.ctrlrange)
        direct = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
        if not (force.any() and actuator.forcelimited != off):
            limited = direct and control.any() and actuator.ctrllimited != off
            force = control * actuator.gainprm[0] if limited else np.full(2, np.nan)
        torque = one_limit(*np.sort(force * float(actuator.gear[0])))
        most[actuator.target] += np.inf if np.isnan(torque) else torque
    for name, torque in most.items():
        joint = spec.joint(name)
        if joint.actfrcrange[1] <= 0 and 0 < torque < np.inf:
            joint.actfrcrange, joint.actfrclimited = [-torque, torque], mujoco.mjtLimited.mjLIMITED_TRUE


def one_limit(lower: float, upper: float) -> float:
    """Return one limit of a torque both ways: the smaller of two, or that of a drive that goes one way alone."""
    return float(min(-lower, upper) if lower < 0 < upper else max(-lower, upper))


def compiled(file: str, spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Return the model of the description in a file.

    Raises:
        RobotError: one that MuJoCo does not compile.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # deprecated elements of somebody's file
            return spec.compile()
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise _unreadable(file, error) from None


def _unreadable(file: str, error: Exception) -> RobotError:
    """Return MuJoCo's message about a file in one line, which begins with the place in the file."""
    reason, place = " ".join((str(error) or "an empty one").split()), None
    lines, number = lines_of(Path(file)), _NUMBER.search(reason)
    if number and int(number[1]):
        place = f"{file}:{number[1]}"
    elif number:  # 0 in an included file: compiled again with all in one text
        try:
            mujoco.MjSpec.from_string("\n".join(text for _, text in lines)).compile()
        except (ValueError, OSError, mujoco.FatalError) as other:
            again = " ".join(str(other).split())
            number = _NUMBER.search(again)
            if number and again.split("Element")[0] == reason.split("Element")[0] and 0 < int(number[1]) <= len(lines):
                place = lines[int(number[1]) - 1][0]
    if place is None and (found := re.search(r"(?:[Ee]lement name|opening file) '([^']+)'", reason)):
        place = line_of(file, found[1])
    reason = reason.removesuffix(" line 0").removesuffix(",")
    return RobotError(f"{place or file}: expected an MJCF or URDF that MuJoCo loads, got {reason[:300]}")
