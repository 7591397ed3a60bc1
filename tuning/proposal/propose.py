"""A scenario proposed from a robot's file: base, limbs, feet, stance, a gait in proportion, parts left out."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import RobotError
from mjx_climb.robot_import.bodies import at_zero, foot_of
from mjx_climb.robot_import.description import JOINTS, SPECK, SPECK_MOMENT, impossible, one_limit
from mjx_climb.robot_import.markup import is_urdf, urdf_limits
from mjx_climb.robot_import.robot_file import REACH
from mjx_climb.scenario.values import G
from tuning.proposal.limbs import Found, Note, driven_joints
from tuning.proposal.stance import STANDING, Section, Stance, Standing, checked, searched
from tuning.proposal.tree import UPRIGHT

# HubRobo v3.2, in proportion to which a gait and a grip are proposed
_MASS, _REACH = 2.2539, 0.287  # kg, m
_STRIDE, _STEP_HEIGHT = 0.05, 0.03  # m
_CONTACT = {"stiffness": 1.0e4, "damping": 20.0, "holding_limit": 15.0}
_CAPTURE, _CLOSING = 5.0e-3, 0.1  # m, s: assumed, as nobody published them
_CONTROL = {"damping": 5.0e3, "stiffness": 5.0e4}
_LOOP = {"kp": 50.0, "kd": 0.2}
_HOLDS_TURNS = {"rotational_stiffness": 30.0, "rotational_damping": 0.06}  # N m/rad, N m s/rad
# factors of stiffness and damping where a robot swings about one foot
_FIRM = {"rotational_stiffness": 10.0, "kp": 10.0, "rotational_damping": 3.0, "kd": 3.0}
_ATTITUDE = 6  # joints of a limb that can keep its foot's attitude
# divisor of the stride of limbs with fewer joints, which turn their feet as the base moves
_SHORT_STRIDE = 8
# largest difference between the heights of a keyframe's feet, over the base's height; one that goes without a word, m
_LEVEL, _SAME = 0.25, 1e-3
_HALVINGS = 5  # of a stride that is too long
_CRAWLING = 4  # limbs of a robot whose cycle has one second for each
_NAMED = 5  # links in a note
_SHORTEST, _LONGEST = 0.01, 10.0  # m, limbs of robots
_DENSEST = 2e4  # kg/m^3: no metal is denser
_WIDEST = 4 * np.pi  # rad between the limits of a joint
# largest miss of footholds, as a share of the reach, by limbs of two joints
_MISSED = 0.02


class Proposal(NamedTuple):
    """Sections of a scenario, and how they came about."""

    sections: Section
    notes: tuple[Note, ...]


def propose(
    file: str | os.PathLike[str], gravity: float = G, base: str | None = None, stand_on: Sequence[str] = ()
) -> Proposal:
    """Return sections of a scenario for the robot in an MJCF or URDF; its time step remains to be chosen.

    It stands on level ground under `gravity`, m/s^2, on the limbs in `stand_on`, by name, or on all that it has. The
    limbs begin at the body `base`, where that is given, in place of the file's first body.

    Raises:
        RobotError: a file that MuJoCo does not load, or one without a base and two limbs of two joints or more; limbs
            that do not start and end equally high, where nobody says which it stands on.
    """
    robot = Found(file, base, stand_on)
    model, limbs = robot.model, robot.limbs
    data = at_zero(model, robot.tree.fixed)
    points = [
        np.array([*data.xanchor[list(chain.joints)], foot_of(model, data, chain.foot, chain.at)])
        for chain in limbs.values()
    ]
    hips = (np.array([row[0] for row in points]) - data.xpos[robot.base]) @ data.xmat[robot.base].reshape(3, 3)
    lengths = np.array([np.linalg.norm(np.diff(row, axis=0), axis=1).sum() for row in points])
    reach, mass = float(lengths.mean()), float(model.body_subtreemass[robot.base])
    slides = bool((model.jnt_type[robot.joints] == mujoco.mjtJoint.mjJNT_SLIDE).any())
    proportions = _proportions(mass, reach, slides)
    keys = [model.key(k).name for k in range(model.nkey)]
    key = next((keys.index(name) for name in ("stance", "stand", "home") if name in keys), 0 if keys else None)
    section: Section = {"file": robot.path, "height": 1.0, "limbs": {}}
    for name, chain in limbs.items():
        section["limbs"][name] = {"joints": [model.joint(j).name for j in chain.joints], "foot": chain.foot}
        section["limbs"][name] |= {"at": list(chain.at)} if any(chain.at) else {}
    more = {"locked": _held(robot, key), "springs": _springs(robot, proportions["control"]), "base": robot.root}
    section |= {key: value for key, value in more.items() if value}
    _note_the_rest(robot)
    _note_units(robot, reach, float(np.linalg.norm(hips, axis=1).max()))
    stance = None if key is None else _of_keyframe(robot, key, section)
    if stance is None:
        robot.note("changed", "stance", "searched: joints off their limits, limbs as far from singular as they get")
        try:
            stance = searched(section, hips, float(lengths.min()))
        except RobotError:
            if advice := robot.other_up(limbs):
                raise RobotError(f"{robot.path}: {advice}") from None
            raise
    section["height"] = stance.height
    for limb, foothold in zip(section["limbs"].values(), stance.footholds.tolist(), strict=True):
        limb["foothold"] = foothold
    gait = _gait(robot, section, stance, reach)
    stiffer = ", the joint loop stiff enough for joints that slide" if slides else ""
    robot.note("changed", "contact and control", f"HubRobo's in proportion to {mass:.3g} kg and {reach:.3g} m{stiffer}")
    if len(limbs) <= STANDING:
        _hold_turns(robot, section, proportions, gait, mass / _MASS * (reach / _REACH) ** 2)
    _note_drives(robot)
    walk = {"gravity": [0.0, 0.0, -gravity], "gait": gait, "duration": 2 * gait["cycle"], **proportions}
    return Proposal({"robot": section, **walk}, tuple(robot.notes))


def _of_keyframe(robot: Found, key: int, section: Section) -> Stance | None:
    """Return how the robot stands in a keyframe, where that is a stance."""
    what, data = f"keyframe {robot.model.key(key).name!r}", mujoco.MjData(robot.model)
    data.qpos[:] = robot.model.key_qpos[key]
    mujoco.mj_kinematics(robot.model, data)
    feet = np.array([foot_of(robot.model, data, chain.foot, chain.at) for chain in robot.limbs.values()])
    feet = (feet - data.xpos[robot.base]) @ data.xmat[robot.base].reshape(3, 3)
    height, apart = -float(feet[:, 2].mean()), float(np.ptp(feet[:, 2]))
    level = apart < _LEVEL * height
    if level and (stance := checked(section, Stance(height, feet[:, :2]))):
        why = f", but for {apart * 1e3:.2g} mm between their heights" if apart > _SAME else ""
        robot.note("taken", f"stance of {what}", f"the feet stand where it puts them{why}")
        return stance
    why = "no stance: limbs singular or joints at their limits with the feet there, made level"
    if not level:
        heights = f"{feet[:, 2].min() * 1e3:.2g} to {feet[:, 2].max() * 1e3:.2g} mm"
        why = f"no stance: its feet are at heights of {heights} from the base, not level below it"
    robot.note("ignored", what, why)
    return None


def _resting(model: mujoco.MjModel, joint: int, value: float) -> float:
    """Return a value of a joint, or the limit that is nearest to it, to six digits."""
    return round(float(np.clip(value, *model.jnt_range[joint])) if model.jnt_limited[joint] else value, 6)


def _held(robot: Found, key: int | None) -> dict[str, float]:
    """Return the joints of no limb and where they are held: at the keyframe's value, or as near to zero as they go."""
    model, held = robot.model, {}
    own = model.body_rootid[model.jnt_bodyid] == model.body_rootid[robot.base]
    for joint in np.flatnonzero(own & np.isin(model.jnt_type, JOINTS)):
        if joint not in robot.joints:
            value = 0.0 if key is None else float(model.key_qpos[key][model.jnt_qposadr[joint]])
            name, why = model.joint(joint).name, "of no limb: held"
            if int(joint) in robot.tree.fixed:
                value, apart = robot.tree.fixed[int(joint)], float(np.ptp(model.jnt_range[joint]))
                unit = "m" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "rad"
                why = f"its limits are {round(apart, 8):.2g} {unit} apart: held"
            held[name] = _resting(model, int(joint), value)
            robot.note("changed", f"joint {name!r}", f"{why} at {held[name]:.3g}")
    return held


def _springs(robot: Found, control: dict[str, float]) -> dict[str, dict[str, float]]:
    """Return a spring for each joint of a limb that nothing drives, where something drives others.

    It is the file's, or else as stiff as a driven joint.
    """
    model, driven, springs = robot.model, driven_joints(robot.described), {}
    for joint in robot.joints:
        name, stiffness = model.joint(joint).name, float(model.jnt_stiffness[joint])
        if driven and name not in driven:
            rest = float(model.qpos_spring[model.jnt_qposadr[joint]]) if stiffness else 0.0
            own = {"stiffness": stiffness} if stiffness else {"stiffness": control["kp"], "damping": control["kd"]}
            springs[name] = own | {"rest": _resting(model, joint, rest)}
            why = "the file's" if stiffness else "as stiff as the joint loop, for the file has none"
            robot.note("changed", f"joint {name!r}", f"nothing drives it: on a spring, {why}")
    return springs


def _note_the_rest(robot: Found) -> None:
    """Note the parts of the file that the dynamics do not need, and those that were mended."""
    full, model = robot.described, robot.model
    others = set(model.body_rootid[1:]) - {model.body_rootid[robot.base]}
    mended = [repr(body.name) for body in full.bodies if impossible(body)]
    named = ", ".join(mended[:_NAMED]) + (f" and {len(mended) - _NAMED} more" if len(mended) > _NAMED else "")
    up = np.empty(3)
    mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 1.0]), model.body_quat[robot.base])
    lost = f"not of the {model.nq} positions that the robot has here, a ball joint being three hinges"
    for number, kind, what, why in (
        (len(full.meshes) - model.nmesh, "ignored", "{} meshes", "looks: masses and inertias are written down"),
        (len(full.sensors), "ignored", "{} sensors", "not simulated"),
        (len(full.tendons), "ignored", "{} tendons", "not simulated"),
        (len(full.equalities), "ignored", "{} mimics" if is_urdf(robot.path) else "{} equality constraints",
         "not simulated"),
        (len(others), "ignored", "{} other bodies", "not the robot"),
        (len(full.actuators), "changed", "{} actuators", "the joint loop's torques take their place"),
        (model.body_gravcomp.any(), "ignored", "gravity compensation", "all links weigh what they weigh"),
        (len(mended), "changed", "moments of inertia", f"no body can have those of {named}: made equal"),
        (up[2] < UPRIGHT, "changed", f"z axis of {model.body(robot.base).name!r}",
         "is taken as up, although the file stands it otherwise"),
        (len(full.keys) - model.nkey, "ignored", "{} keyframes",
         "they begin at the file's own root" if robot.root else lost),
    ):  # fmt: skip
        if number:
            robot.note(kind, what.format(number), why)
    for body in np.flatnonzero(model.body_jntnum > 0):
        what = f"link {model.body(body).name!r}"
        if model.body_mass[body] <= SPECK:
            robot.note("changed", what, "has no mass: it gets a speck of one")
        elif model.body_inertia[body].max() <= SPECK_MOMENT:
            robot.note("taken", what, "as a point: the file gives it a mass alone")


def _note_units(robot: Found, reach: float, hips: float) -> None:
    """Warn of lengths, weights and angles that seem to be in other units, as are moments of inertia of larger things.

    A rod as long as a whole limb, `reach` m, has a radius of gyration of 0.29 times that; a base ends some way beyond
    the limbs' beginnings, `hips` m from its middle.
    """
    model = robot.model
    if not _SHORTEST < reach < _LONGEST:
        robot.note("warning", "lengths", f"a limb is {reach:.3g} m long: units?")
    elif (density := model.body_subtreemass[robot.base] / (reach + hips) ** 3) > _DENSEST:
        robot.note("warning", "masses", f"{density:.2g} kg in each cubic metre that the robot takes up: units?")
    turning = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    spans = np.ptp(model.jnt_range, axis=1) * (turning & (model.jnt_limited > 0))
    if far := [joint for joint in robot.joints if spans[joint] > _WIDEST]:
        why = f"up to {spans[far].max():.3g} rad apart, as if they were degrees"
        robot.note("warning", f"limits of {len(far)} joints", why)
    limbs = {int(body) for body in model.jnt_bodyid[robot.joints]}
    own = np.flatnonzero((model.body_rootid == model.body_rootid[robot.base]) & (model.body_mass > SPECK))
    radii = {int(body): float(np.sqrt(model.body_inertia[body].max() / model.body_mass[body])) for body in own}
    wide = [body for body, radius in radii.items() if radius > (reach / 2 if body in limbs else reach + hips)]
    if wide:
        worst = max(wide, key=lambda body: radii[body])
        others = f", as of {len(wide) - 1} others" if len(wide) > 1 else ""
        weight = f"{model.body_inertia[worst].max():.3g} kg m^2 with {model.body_mass[worst]:.3g} kg"
        why = f"{weight}, a radius of gyration of {radii[worst]:.3g} m{others}; a limb is {reach:.3g} m long: units?"
        robot.note("warning", f"inertia of {model.body(worst).name!r}", why)


def _note_drives(robot: Found) -> None:
    """Note the values taken with the joints, and those that they lack."""
    model, joints = robot.model, robot.joints
    dofs = model.jnt_dofadr[joints]
    limits = np.array([one_limit(*model.jnt_actfrcrange[joint]) for joint in joints if model.jnt_actfrclimited[joint]])
    some = "" if len(limits) == len(joints) else f", of {len(limits)} joints"
    for values, what, of in (
        (model.dof_armature[dofs], "armature of the joints", ""),
        (model.dof_damping[dofs], "damping of the joints", ""),
        (model.dof_frictionloss[dofs], "dry friction of the joints", ""),
        (limits, "torque limits", some),
    ):
        if values.any():
            robot.note("taken", what, f"{values.min():.3g} to {values.max():.3g}{of}")
    efforts, speeds = (urdf_limits(robot.path, key) for key in ("effort", "velocity"))
    names = [model.joint(joint).name for joint in joints]
    if none := sum(efforts.get(name) == 0 for name in names):
        robot.note("changed", f"torque limits of {none} joints", 'effort="0" in the file: taken for none given')
    if given := [speeds[name] for name in names if name in speeds]:
        why = f"{min(given):.3g} to {max(given):.3g} in the file: hardware.servo.no_load_speed limits speeds"
        robot.note("ignored", f"velocity limits of {len(given)} joints", why)
    if model.dof_dampingpoly[dofs].any() or model.jnt_stiffnesspoly[joints].any():
        robot.note("ignored", "damping and stiffness", "beyond the part that is linear")
    if free := int((model.jnt_limited[joints] == 0).sum()):
        why = f"the file has none: half a turn either way, or {REACH:g} m where they slide"
        robot.note("changed", f"limits of {free} joints", why)


# ------------------------------------------------------------------------------------------------------------
# Gait, grip and gains


def _gait(robot: Found, section: Section, stance: Stance, reach: float) -> Section:
    """Return a crawl: up one side from behind, then up the other, strides and steps that all limbs can reach."""
    (height, footholds), names = stance, list(section["limbs"])
    order = sorted(range(len(names)), key=lambda n: (footholds[n, 1] < 0, footholds[n, 0]))
    worth = Standing(section, footholds, _MISSED * reach).worth
    for shorter in (2**halvings for halvings in range(_HALVINGS + 1)):
        stride, step = _STRIDE * reach / _REACH / shorter, _STEP_HEIGHT * reach / _REACH / shorter
        stances = [Stance(height, footholds + np.array([x, 0.0])) for x in (-stride, stride)]
        if (worth(*stances, Stance(height - step, footholds)) > 0).all():
            break
    else:
        why = "limbs do not reach footholds even so near to those where they stand: look at the stance"
        robot.note("changed", f"stride {_two_digits(stride):g} m", why)
    within = f", the stride 1/{shorter} of that for joint limits" if shorter > 1 else ""
    robot.note("changed", "gait", f"a crawl in proportion to limbs of {reach:.3g} m{within}")
    share = 1 - 1 / len(names)
    load = max(1.0, (_CRAWLING - 1) / (len(names) - 1))  # of each foot on the ground, in that of a robot of four
    return {
        "cycle": len(names) * load,
        "duty": max(0.75, -(-share * 100 // 1) / 100),
        "stride": _two_digits(stride),
        "step_height": _two_digits(step),
        "sequence": [names[n] for n in order],
    }


def _hold_turns(robot: Found, section: Section, proportions: Section, gait: Section, size: float) -> None:
    """Give a robot that stands on one or two feet grips that transmit moments; `size` is its mass times reach squared.

    A robot that swings about one foot sags by grip and joints, and the other foot shuts where it should not, so both
    are firm where limbs can keep the attitude of their feet. Others turn them as the base moves.
    """
    contact, control = proportions["contact"], proportions["control"]
    contact |= {key: value * size for key, value in _HOLDS_TURNS.items()}
    springs = section.get("springs", {})
    if min(sum(joint not in springs for joint in limb["joints"]) for limb in section["limbs"].values()) >= _ATTITUDE:
        for part in (contact, control):
            part |= {key: value * part[key] for key, value in _FIRM.items() if key in part}
        why = "it and the joint loop are firm enough for one foot"
    else:
        gait["stride"] = _two_digits(gait["stride"] / _SHORT_STRIDE)
        turn = f"it resists limbs of under {_ATTITUDE} joints, which turn their feet"
        why = f"{turn}: short strides, and it may let go"
    robot.note("changed", "grip", f"transmits moments: on one or two feet held as points the robot swings; {why}")
    for part in (contact, control):
        part |= {key: _two_digits(part[key]) for key in (*_HOLDS_TURNS, "kp", "kd") if key in part}


def _proportions(mass: float, reach: float, slides: bool) -> Section:
    """Return grip and gains of HubRobo for another weight and length.

    kp is one number for N m/rad and N/m: sliding joints shorter than a metre need the stiffness that turning ones have
    at the foot.
    """
    heavier = mass / _MASS
    turning = heavier * reach / _REACH * (max(1.0, reach**-2) if slides else 1.0)
    contact, control, loop = (
        {name: _two_digits(value * times) for name, value in values.items()}
        for values, times in ((_CONTACT, heavier), (_CONTROL, heavier), (_LOOP, turning))
    )
    contact |= {"capture_distance": _two_digits(_CAPTURE * reach / _REACH), "closing_time": _CLOSING}
    return {"contact": contact, "control": control | loop}


def _two_digits(value: float) -> float:
    return float(f"{value:.2g}")
