"""Logs of a gripped robot by MuJoCo's C code alone: base free, a spring and a damper between each foot and its grip."""

import dataclasses

import mujoco
import numpy as np

from mjx_climb.physics.inverse_kinematics import inverse_kinematics, limb_geometry
from mjx_climb.physics.kinematics import limb_frames
from mjx_climb.physics.spatial import quaternion_from_rotation_vector, quaternion_to_matrix
from mjx_climb.robot_import.load import load_robot, load_spec
from tests.tuning.identification.stand_in_mujoco import JOINTS
from tuning.identification.readers.log import Log, Signal

LIMBS = ("LF", "LH", "RH", "RF")


@dataclasses.dataclass(frozen=True)
class Truth:
    """The robot that recorded the log."""

    stiffness: float = 1.0e4  # N/m, of a grip
    damping: float = 20.0  # N s/m
    armature: float = 0.012
    friction: float = 0.0  # N m, dry
    kp: float = 50.0
    kd: float = 0.2
    base_mass: float | None = None  # kg; None: its file's
    base_center: tuple = (0.0, 0.0, 0.0)  # m, of the base's mass, from where its file has it
    base_spread: float = 1.0  # inertia of the base, of that of its mass as its file spreads it
    delay: float = 0.0  # s, of the commands
    gravity: tuple = (0.0, 0.0, -9.81)
    gain: float = 1.0  # of the force sensors
    bias: float = 0.0  # N


TRUTH = Truth()
NOISE = {"position": 5e-4, "velocity": 0.02, "effort": 0.02, "force": 0.05, "base_position": 2e-4}


def free_model(name, truth):
    """Return the model of a robot with a free base and position actuators, without any contact."""
    spec = load_spec(name)
    for key in list(spec.keys):
        spec.delete(key)
    joints = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]
    for joint in joints:
        joint.armature, joint.frictionloss = truth.armature, truth.friction
        joint.damping = [0.0, 0, 0]
        joint.solref_friction, joint.solimp_friction = [0.0005, 1.0], [0.999, 0.999, 0.001, 0.5, 2.0]
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0)
        actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = truth.kp, -truth.kp, -truth.kd
    spec.option.gravity = truth.gravity
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    model = spec.compile()
    if truth.base_mass is not None:
        model.body_inertia[1] *= truth.base_spread * truth.base_mass / model.body_mass[1]
        model.body_mass[1] = truth.base_mass
    model.body_ipos[1] += truth.base_center
    return model


def swayed(truth, time, targets, *, step=1e-4, name="hubrobo_v3_2", lead=0.0):
    """Return what a robot does under targets (T, 12) at times (T,) s, each held until the next; arrays by kind.

    It grips in its rest stance and stands at the first targets for `lead` s before. The step is semi-implicit Euler's:
    forces at its beginning, rates half a step before angles.
    """
    robot, model = load_robot(name), free_model(name, truth)
    model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_EULER
    data = mujoco.MjData(model)
    joints = model.actuator_trnid[:, 0]
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    data.qpos[:7] = [*robot.stance_position, *robot.stance_orientation]
    data.qpos[places] = np.ravel(robot.stance_joints)
    mujoco.mj_forward(model, data)
    data.qpos[:3] += robot.stance_position - data.xpos[1]
    mujoco.mj_forward(model, data)
    sites = [model.site(i).id for i in range(model.nsite)]
    grips = data.site_xpos[sites].copy()
    jacobian = np.zeros((len(sites), 3, model.nv))
    found = {kind: [] for kind in ("position", "velocity", "effort", "force", "base_position", "base_orientation")}
    first = -round(lead / step)
    due = np.maximum(
        np.searchsorted(time, np.arange(first, round(time[-1] / step) + 1) * step - truth.delay + 1e-9) - 1, 0
    )
    k = first
    for moment in time:
        while True:
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            for n, site in enumerate(sites):
                mujoco.mj_jacSite(model, data, jacobian[n], None, site)
            force = truth.stiffness * (grips - data.site_xpos[sites]) - truth.damping * (jacobian @ data.qvel)
            data.qfrc_applied[:] = np.einsum("nij,ni->j", jacobian, force)
            data.ctrl[:] = targets[due[k - first]]
            if k >= round(moment / step):
                break
            mujoco.mj_step(model, data)
            k += 1
        mujoco.mj_forward(model, data)
        orientation = np.zeros(4)
        mujoco.mju_mulQuat(orientation, data.qpos[3:7], np.array([1.0, 0, 0, 0]))
        seen = (data.qpos[places], data.qvel[dofs], data.actuator_force, force, data.xpos[1], orientation)
        for kind, value in zip(found, seen, strict=True):
            found[kind].append(np.array(value))
    return {kind: np.array(values) for kind, values in found.items()}


def sways(duration, step, *, amplitude=1.0, top=4.0, seed=0, name="hubrobo_v3_2"):
    """Return times (T,) and joint targets (T, 12): the base shifts and turns by sines from rest, the feet stay."""
    rng, robot = np.random.default_rng(seed), load_robot(name)
    time = np.arange(round(duration / step) + 1) * step
    moved = np.zeros((len(time), 6))
    for axis, room in enumerate(np.repeat([0.012, 0.06], 3) * amplitude):
        for frequency in np.geomspace(0.3, top, 6) * rng.uniform(0.9, 1.1, 6):
            moved[:, axis] += room * rng.uniform(0.3, 0.6) * np.sin(2 * np.pi * frequency * time + rng.uniform(0, 6.28))
    moved *= np.minimum(time / 0.5, 1.0)[:, None] ** 2
    feet = limb_frames(robot, None, np.asarray(robot.stance_joints)).foot
    turned = np.array([quaternion_to_matrix(np.asarray(quaternion_from_rotation_vector(v))) for v in moved[:, 3:]])
    seen = (feet - moved[:, None, :3]) @ turned
    found = inverse_kinematics(limb_geometry(robot), seen)
    assert bool(np.all(found.reachable))
    return time, np.asarray(found.joint_angles).reshape(len(time), -1)


def log_of(truth, duration=8.0, rate=100.0, *, kinds=("position", "velocity", "force"), seed=0, targets=None, **motion):
    """Return a noisy log of a sway; targets (T, 12) at its rate replace the sway."""
    rng = np.random.default_rng(seed)
    time, own = sways(duration, 1 / rate, **motion)
    targets = own if targets is None else targets
    time = np.arange(len(targets)) / rate
    true = swayed(truth, time, targets, lead=1.0)
    true["force"] = truth.gain * true["force"] + truth.bias
    signals = {f"{joint}.command": Signal(time, targets[:, n]) for n, joint in enumerate(JOINTS)}
    for kind in kinds:
        values = true[kind].reshape(len(time), -1)
        values = values + rng.normal(0, NOISE[kind], values.shape)
        names = [f"{joint}.{kind}" for joint in JOINTS]
        if kind == "force":
            names = [f"{limb}.force.{axis}" for limb in LIMBS for axis in "xyz"]
        elif kind == "base_position":
            names = [f"base.position.{axis}" for axis in "xyz"]
        signals |= {name: Signal(time, value) for name, value in zip(names, values.T, strict=True)}
    return Log(signals, "log.csv")
