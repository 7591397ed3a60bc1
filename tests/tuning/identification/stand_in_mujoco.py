"""Logs of a robot on a stand by MuJoCo's C code alone: its own friction, actuators and integrator, base welded."""

import dataclasses

import mujoco
import numpy as np

from mjx_climb.robot_import.load import load_robot, load_spec
from tuning.identification.readers.log import KP, OFF, Log, Signal

JOINTS = tuple(f"{limb}.{joint}" for limb in ("LF", "LH", "RH", "RF") for joint in ("coxa", "femur", "tibia"))


@dataclasses.dataclass(frozen=True)
class Truth:
    """The robot that recorded the log; numbers, or one for each of the 12 joints."""

    armature: float = 0.012
    friction: float = 0.05
    damping: float = 0.03
    kp: float = 40.0
    kd: float = 0.3
    delay: float = 0.0  # s, of the commands
    gravity: tuple = (0.0, 0.0, -9.81)
    stribeck: float = 0.0  # N m, friction at rest beside the rest of it
    integrator: str = "RK4"
    heavier: float = 1.0  # masses of all links over those of the robot's file
    mass: float = 0.0  # kg, hung on each foot
    soft: bool = False  # dry friction as MuJoCo has it by default
    flexible: float = 0.0  # N m/rad, a joint between knee and link; 0: stiff


TRUTH = Truth()
NOMINAL = 50.0  # N m/rad, that the robot is told where it has the P gain of the truth


def welded_spec(name, truth):
    """Return the description of a robot whose base is welded to the world, with position actuators."""
    spec = load_spec(name)
    spec.delete(next(joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE))
    for key in list(spec.keys):
        spec.delete(key)
    robot = load_robot(name)
    base = spec.bodies[1]
    base.pos, base.quat = robot.stance_position, robot.stance_orientation
    for body in spec.bodies[2:]:
        for field in ("mass", "inertia", "fullinertia"):
            setattr(body, field, truth.heavier * getattr(body, field))
    for site in spec.sites[:4] if truth.mass else ():
        site.parent.add_body(
            pos=site.pos, ipos=np.zeros(3), mass=truth.mass, inertia=[1e-12] * 3, explicitinertial=True
        )
    for joint in list(spec.joints):
        actuator = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=1.0)
    if truth.flexible:
        for body in [body for body in spec.bodies if body.name.endswith("tibia")]:
            axis = body.joints[0].axis
            body.add_joint(
                name=f"{body.name}_flex",
                axis=axis,
                stiffness=[truth.flexible, 0, 0],
                damping=[0.002, 0, 0],
                armature=1e-4,
            )
    spec.option.gravity = truth.gravity
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    for number, joint in enumerate(j for j in spec.joints if not j.name.endswith("flex")):
        for field, value in (("armature", truth.armature), ("frictionloss", truth.friction)):
            setattr(joint, field, float(np.broadcast_to(value, 12)[number]))
        joint.damping = [float(np.broadcast_to(truth.damping, 12)[number]), 0, 0]
        if not truth.soft:
            joint.solref_friction, joint.solimp_friction = [0.0005, 1.0], [0.999, 0.999, 0.001, 0.5, 2.0]
    for number, actuator in enumerate(spec.actuators):
        kp, kd = (float(np.broadcast_to(value, 12)[number]) for value in (truth.kp, truth.kd))
        actuator.gainprm[0], actuator.biasprm[1], actuator.biasprm[2] = kp, -kp, -kd
    return spec


def welded(name, truth):
    """Return the model of a robot whose base is welded to the world, with position actuators."""
    return welded_spec(name, truth).compile()


def sines(duration, step, *, amplitude=0.25, top=4.0, seed=0):
    """Return times (T,) and joint targets (T, 12): chirps from 0.2 Hz to `top`, each joint at its own phase."""
    rng, robot = np.random.default_rng(seed), load_robot("hubrobo_v3_2")
    time = np.arange(round(duration / step) + 1) * step
    sweep = 2 * np.pi * (0.2 * time + (top - 0.2) * time**2 / (2 * max(duration, 1e-9)))
    phase = rng.uniform(0, 2 * np.pi, 12)
    shape = np.sin(sweep[:, None] + phase) - np.sin(phase)
    return time, robot.stance_joints.ravel() + amplitude * shape


def recorded(truth, time, targets, step=2.5e-4, name="hubrobo_v3_2", share=None):
    """Return positions, velocities and efforts (T, 12) at the times of targets (T, 12), which are held between them.

    `share` (T,) of the P gain holds as the targets do, and reaches the servos with them; 0: their torque is off.
    """
    model = welded(name, truth)
    model.opt.timestep, model.opt.integrator = step, getattr(mujoco.mjtIntegrator, f"mjINT_{truth.integrator}")
    data = mujoco.MjData(model)
    joints = model.actuator_trnid[:, 0]
    places, dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
    data.qpos[places] = targets[0]
    found = {"position": [], "velocity": [], "effort": []}
    late = np.maximum(np.searchsorted(time, np.arange(round(time[-1] / step) + 1) * step - truth.delay + 1e-9) - 1, 0)
    gain, bias = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()

    def send(row):
        data.ctrl[:] = targets[row]
        if share is not None:
            model.actuator_gainprm[:], model.actuator_biasprm[:] = share[row] * gain, bias
            model.actuator_biasprm[:, 1] *= share[row]
            model.actuator_biasprm[:, 2] *= share[row] > 0

    k = 0
    for sample in range(len(time)):
        while k < round(time[sample] / step):
            send(late[k])
            if truth.stribeck:
                rate = data.qvel[dofs]
                data.qfrc_applied[dofs] = -truth.stribeck * np.tanh(rate / 0.02) * np.exp(-((rate / 0.3) ** 2))
            mujoco.mj_step(model, data)
            k += 1
        send(late[k])
        mujoco.mj_forward(model, data)
        for name_, value in (
            ("position", data.qpos[places]),
            ("velocity", data.qvel[dofs]),
            ("effort", data.actuator_force),
        ):
            found[name_].append(value.copy())
    return {name_: np.array(value) for name_, value in found.items()}


NOISE = {"position": 1e-3, "velocity": 0.03, "effort": 0.02}


def log_of(
    truth,
    duration=6.0,
    rate=100.0,
    *,
    noise=NOISE,
    jitter=0.0,
    misread=0.0,
    step=2.5e-4,
    seed=0,
    drop=(),
    kinds=("position", "velocity"),
    gains=(),
    **motion,
):
    """Return a noisy log; `jitter` s moves the samples, `misread` s their time stamps alone, `drop` are spans without.

    `gains` are P gains and when each begins, as the robot is told them: at NOMINAL it has the truth's; 0: torque off.
    """
    rng = np.random.default_rng(seed)
    time, targets = sines(duration, 1 / rate, **motion)
    fine = np.arange(round(duration / step) + 1) * step
    told = np.full(len(time), NOMINAL)
    for begin, kp in gains:
        told[time > begin - 1e-9] = kp
    of_time = np.minimum((fine * rate + 1e-6).astype(int), len(time) - 1)
    true = recorded(truth, fine, targets[of_time], step, share=told[of_time] / NOMINAL if gains else None)
    when = np.clip(time + rng.normal(0, jitter, time.shape) if jitter else time, 0, duration)
    when = np.maximum.accumulate(when + np.arange(len(when)) * 1e-9)
    keep = np.all([(when < a) | (when > b) for a, b in drop], axis=0) if drop else np.ones(len(when), bool)
    stamps = when + np.random.default_rng((seed, 1)).normal(0, misread, when.shape) if misread else when
    signals = {}
    for j, joint in enumerate(JOINTS):
        signals[f"{joint}.command"] = Signal(time, targets[:, j])
        for kind in kinds:
            value = np.interp(when, fine, true[kind][:, j]) + rng.normal(0, noise[kind], when.shape)
            signals[f"{joint}.{kind}"] = Signal(stamps[keep], value[keep])
    if gains:
        signals |= {KP: Signal(time[told > 0], told[told > 0]), OFF: Signal(time, np.where(told > 0, 0.0, 1.0))}
    return Log(signals, "log.csv")


def columns_of(log):
    """Return the columns of a CSV file of a log whose signals have the same times."""
    time = next(iter(log.signals.values())).time
    return {"time": time, **{name: signal.value for name, signal in log.signals.items()}}
