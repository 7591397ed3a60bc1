"""Peers on MuJoCo: its bare dynamics, and the walk under base admittance as its user would write it in NumPy.

The walk, without any metrics, is a second implementation: gait, grip, Eq. 3 of the paper and inverse kinematics share
no code with `mjx_climb`, whose scenario and MuJoCo model alone they read. Arrays are components first, limbs second,
robots last, all contiguous.
"""

import abc
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from mujoco import batch, rollout

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot_import.load import load_spec
from mjx_climb.scenario.model import Cargo, Push

FEET = ("LF_foot", "LH_foot", "RH_foot", "RF_foot")
BASE = 1  # body
_ARRAYS = ("qpos", "qvel", "site_xpos", "xipos", "sensordata", "qfrc_applied", "xfrc_applied")
# after this step, with the walk's forces and the state (qpos, qvel) at its start
Watch = Callable[[int, "Walker", np.ndarray, np.ndarray], None]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the vector product over the leading axis; numpy's own is several times slower."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


class Walker:
    """Grip and controller of N robots; `foot_force` (3, 4, N) and `torque` (3, 4, N) are of the last call."""

    def __init__(self, model: mujoco.MjModel, scenario: mc.Scenario, gains: Mapping[str, np.ndarray]):
        """Begin a walk in the rest stance with gains (N, 6) `inertia`, `damping` and `stiffness`.

        Raises:
            ValueError: a scenario with another law or gait than these peers know.
        """
        control, gait = scenario.control, scenario.gait
        contact: Any = scenario.contact  # the gripper
        if (control.controller, control.reading) != ("base_admittance", "virtual_model"):
            raise ValueError("the NumPy peers know base admittance with its virtual model alone")
        if gait.base_reference != "nominal" or gait.heading or gait.swing != "cubic":
            raise ValueError("the NumPy peers walk along x from the nominal base position, by cubic swings, alone")
        self.control, self.gait, self.contact = control, gait, contact
        self.transition = _zero_order_hold(gains, scenario.time_step)
        limbs = [foot.split("_")[0] for foot in FEET]
        self.cycle = round(gait.cycle / scenario.time_step)
        self.swing = self.cycle - math.ceil(gait.duty * self.cycle - 1e-6)
        self.lift_off = np.array([int(gait.sequence.index(limb) / len(limbs) * self.cycle + 0.5) for limb in limbs])
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        mujoco.mj_kinematics(model, data)
        count = len(gains["stiffness"])
        self.base = data.xpos[BASE].copy()
        self.footholds = np.stack([data.site(foot).xpos for foot in FEET], axis=1)  # (3, 4)
        self.limb_geometry = _limb_geometry(model, limbs)
        self.anchor = np.repeat(self.footholds[:, :, None], count, axis=2)
        self.touching = np.ones((len(limbs), count), bool)
        self.lost = np.zeros_like(self.touching)
        self.shift, self.rate = np.zeros((6, count)), np.zeros((6, count))

    def __call__(self, step: int, base: np.ndarray, foot: np.ndarray, foot_velocity: np.ndarray,
                 angles: np.ndarray, rates: np.ndarray) -> None:  # fmt: skip
        """Compute the foot forces and joint torques of a step.

        Takes base position (3, N) m, feet (3, 4, N) m and their velocities, joint angles (3, 4, N) rad and rates.
        """
        cycle, in_cycle = divmod(step, self.cycle)
        contact, gait, since = self.contact, self.gait, (in_cycle - self.lift_off) % self.cycle
        swinging = since < self.swing

        # grip: a spring and a damper to where the foot met the ground
        holds = ~(swinging[:, None] | self.lost)
        touching = holds | (foot[2] <= 0)
        landed = touching & ~self.touching
        if landed.any():
            self.anchor[:2, landed] = foot[:2, landed]
            self.anchor[2, landed] = 0.0
        self.touching = touching
        force = (-contact.stiffness * (foot - self.anchor) - contact.damping * foot_velocity) * touching
        if contact.holding_limit is not None:
            pulled = holds & (force[2] < 0)
            if pulled.any():
                self.lost |= pulled & ((force * force).sum(0) > contact.holding_limit**2)

        # Eq. 3, driven by -w so that the base yields
        wrench, was = np.concatenate([force.sum(1), cross(foot - base[:, None], force).sum(1)]), self.shift
        self.shift, self.rate = (row[0] * was + row[1] * self.rate - row[2] * wrench for row in self.transition)

        # where base and feet should be, then the joints
        target = self.anchor.copy()
        for limb in np.flatnonzero(swinging):
            phase = min(since[limb] / self.swing / (1 - gait.settling), 1.0)
            curve = self.footholds[:, limb].copy()
            curve[0] += gait.stride * (cycle + _cubic(phase))
            curve[2] += gait.step_height * _cubic(2 * phase if phase < 0.5 else 2 - 2 * phase)
            target[:, limb] = curve[:, None]
        reference = self.base.copy()
        reference[0] += gait.stride * (cycle + _cubic(in_cycle / self.cycle))
        relative = target - (reference[:, None] + self.shift[:3])[:, None]
        joints = self.inverse_kinematics(_turned_back(self.shift[3:], relative))
        self.foot_force, self.torque = force, self.control.kp * (joints - angles) - self.control.kd * rates

    def inverse_kinematics(self, foot: np.ndarray) -> np.ndarray:
        """Return the joint angles (3, 4, N) rad for feet in the base frame; nearest reach where there is none."""
        g = self.limb_geometry
        x, y, z = (axis[0] * foot[0] + axis[1] * foot[1] + axis[2] * foot[2] for axis in g["axes"])
        x, y, z = x - g["origin"][0], y - g["origin"][1], z - g["origin"][2]
        reach = np.hypot(x, y)
        coxa = np.arctan2(y, x) - np.arcsin(g["lateral"] / reach)
        x = np.sqrt(reach**2 - g["lateral"] ** 2) - g["femur_out"]
        a, b = g["femur_length"], g["tibia_length"]
        square = x * x + z * z
        # law of cosines for the bend at the knee and for the angle at the femur's joint
        bend = np.arccos(np.clip((square - a * a - b * b) / (2 * a * b), -1, 1))
        inner = np.arccos(np.clip((square + a * a - b * b) / (2 * a * np.sqrt(square)), -1, 1))
        femur = g["femur_sign"] * np.arctan2(z, x) - g["inner_sign"] * inner
        return np.asarray(np.stack([coxa, femur, g["bend_sign"] * bend]) + g["zero"])


class _Peer(abc.ABC):
    """Robots on their way."""

    arrays: Sequence[np.ndarray]  # of MuJoCo's state, by the names of `_ARRAYS`, (N, ...) each

    def __init__(self, scenario: mc.Scenario, gains: Mapping[str, np.ndarray]):
        """Load the scenario's robot, with a sensor for the velocity of each foot, and begin its walk."""
        spec = load_spec(scenario.robot)
        for foot in FEET:
            spec.add_sensor(type=mujoco.mjtSensor.mjSENS_FRAMELINVEL, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=foot)
        self.model = _compiled(spec, scenario)
        self.walker, self.step, self.cargo = Walker(self.model, scenario, gains), 0, 0.0
        self.base_mass, self.sites = self.model.body_mass[BASE], [self.model.site(foot).id for foot in FEET]
        self.tibias = self.model.site_bodyid[self.sites]

        def steps(part: Cargo | Push) -> range:
            stop = sys.maxsize if part.stop is None else round(part.stop / scenario.time_step)
            return range(round(part.start / scenario.time_step), stop)

        cargo, pushes = scenario.disturbance.cargo, scenario.disturbance.pushes
        self._cargo = cargo.mass, steps(cargo)
        self._pushes = [(np.concatenate([push.force, push.moment]), steps(push)) for push in pushes]

    def run(self, steps: int, watch: Watch | None = None) -> None:
        """Walk on for some steps."""
        qpos, qvel, site, xipos, sensed, joint_force, body_wrench = self.arrays
        walker, count, (mass, loaded) = self.walker, len(qpos), self._cargo

        def joints(values: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(values.reshape(count, -1, 3).transpose(2, 1, 0))

        for step in range(self.step, self.step + steps):
            cargo = mass if step in loaded else 0.0
            if cargo != self.cargo:
                self.cargo = cargo
                self._load(self.base_mass + cargo)
            foot = np.ascontiguousarray(site[:, self.sites].transpose(2, 1, 0))
            base = np.ascontiguousarray(qpos[:, :3].T)
            walker(step, base, foot, joints(sensed), joints(qpos[:, 7:]), joints(qvel[:, 6:]))
            # MuJoCo takes a body's force at its centre of mass
            arm = foot - xipos[:, self.tibias].transpose(2, 1, 0)
            body_wrench[:, self.tibias, :3] = walker.foot_force.transpose(2, 1, 0)
            body_wrench[:, self.tibias, 3:] = cross(arm, walker.foot_force).transpose(2, 1, 0)
            body_wrench[:, BASE] = sum((push for push, pushed in self._pushes if step in pushed), np.zeros(6))
            joint_force[:, 6:] = walker.torque.transpose(2, 1, 0).reshape(count, -1)
            if watch is not None:
                watch(step, walker, qpos, qvel)
            self._advance()
        self.step += steps

    @abc.abstractmethod
    def _load(self, base_mass: float) -> None:
        """Change the mass of the base, kg."""

    @abc.abstractmethod
    def _advance(self) -> None:
        """Finish a step, and begin the next one as far as its controller."""


class Batch(_Peer):
    """Many robots, `mujoco.batch` stepping them on threads."""

    def __init__(self, scenario: mc.Scenario, gains: Mapping[str, np.ndarray], threads: int):
        super().__init__(scenario, gains)
        # persistent, so that a step goes on from the kinematics that the controller saw
        self.batch = batch.Batch(self.model, len(gains["stiffness"]), threads, persistent=True)
        for field in ("site_xpos", "xipos", "sensordata"):
            self.batch.bind(field)
        self.batch.reset(keyframe=0, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.arrays = [getattr(self.batch, name) for name in _ARRAYS]

    def _load(self, base_mass: float) -> None:
        self.batch.expand("body_mass")[:, BASE] = base_mass
        self.batch.set_const()
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def _advance(self) -> None:
        self.batch.step(stage=mujoco.mjtStage.mjSTAGE_VEL)


class Loop(_Peer):
    """One robot, with gains (1, 6), in a loop of Python with the controller between the halves of a step."""

    def __init__(self, scenario: mc.Scenario, gains: Mapping[str, np.ndarray]):
        super().__init__(scenario, gains)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        mujoco.mj_step1(self.model, self.data)
        self.arrays = [getattr(self.data, name)[None] for name in _ARRAYS]

    def _load(self, base_mass: float) -> None:
        self.model.body_mass[BASE] = base_mass
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))
        mujoco.mj_step1(self.model, self.data)

    def _advance(self) -> None:
        mujoco.mj_step2(self.model, self.data)
        mujoco.mj_step1(self.model, self.data)


def _cubic(s: float) -> float:
    return s * s * (3.0 - 2.0 * s)


def _turned_back(rotation_vector: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors (3, 4, N) by the inverse of rotation vectors (3, N), after Rodrigues."""
    angle = np.sqrt((rotation_vector * rotation_vector).sum(0))
    small = angle < 1e-5
    divisor = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0, np.sin(angle) / divisor)
    versine = np.where(small, 0.5, (1 - np.cos(angle)) / divisor**2)
    axis = np.broadcast_to(rotation_vector[:, None], vectors.shape)
    turned = cross(axis, vectors)
    return np.asarray(vectors - sine * turned + versine * cross(axis, turned))


def _zero_order_hold(gains: Mapping[str, np.ndarray], time_step: float) -> np.ndarray:
    """Return rows of the exact step of `M xdd + D xd + K x = f` over (x, xd, f), (2, 3, 6, N)."""
    m, d, k = (np.asarray(gains[name], float) for name in ("inertia", "damping", "stiffness"))
    system = np.zeros((*k.shape, 3, 3))
    system[..., 0, 1] = time_step
    system[..., 1, :] = np.stack([-k / m, -d / m, 1 / m], axis=-1) * time_step
    # the matrix exponential: the Taylor series of a halved matrix by Horner's rule, squared as often as it was halved
    halvings = max(math.ceil(math.log2(np.abs(system).sum(-1).max())) + 1, 0)
    result = np.eye(3)
    for order in range(15, 0, -1):  # the rest is below 0.5^16 / 16!
        result = np.eye(3) + system / 2**halvings @ result / order
    result = np.linalg.matrix_power(result, 2**halvings)
    return np.ascontiguousarray(result[..., :2, :].transpose(2, 3, 1, 0))


def _limb_geometry(model: mujoco.MjModel, limbs: list[str]) -> dict[str, np.ndarray]:
    """Return the constants of the inverse kinematics in the rest stance; the last axes are limbs and robots (4, 1).

    A limb's own axes there: out from the coxa's axis towards the foot, to the side along the parallel axes of femur and
    tibia, up along the coxa's.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(model, data)
    rows = []
    for limb in limbs:
        last = model.body_jntadr[model.site(f"{limb}_foot").bodyid[0]]  # of the limb's three
        joints = [last - 2, last - 1, last]
        coxa, femur, tibia = data.xanchor[joints]
        foot = data.site(f"{limb}_foot").xpos
        up, femur_axis, tibia_axis = data.xaxis[joints]
        out = np.cross(up, femur_axis)
        out *= np.sign(out @ (foot - coxa))
        axes = np.stack([out, np.cross(up, out), up])
        (x, _, z), (u, _, w) = axes @ (tibia - femur), axes @ (foot - tibia)
        # a turn about the side lowers
        femur_sign, tibia_sign = -np.sign(axes[1] @ femur_axis), -np.sign(axes[1] @ tibia_axis)
        thigh, bend = np.arctan2(z, x), np.arctan2(x * w - z * u, x * u + z * w)
        zero = data.qpos[model.jnt_qposadr[joints]] - [0, femur_sign * thigh, tibia_sign * bend]
        rows.append({
            "axes": axes, "origin": axes @ coxa + [0, 0, up @ (femur - coxa)], "lateral": axes[1] @ (foot - coxa),
            "femur_out": out @ (femur - coxa), "femur_length": np.hypot(x, z), "tibia_length": np.hypot(u, w),
            "femur_sign": femur_sign, "inner_sign": femur_sign * np.sign(bend),
            "bend_sign": tibia_sign * np.sign(bend), "zero": zero,
        })  # fmt: skip
    return {name: np.stack([row[name] for row in rows], axis=-1)[..., None] for name in rows[0]}


def _compiled(spec: mujoco.MjSpec, scenario: mc.Scenario) -> mujoco.MjModel:
    model = spec.compile()
    model.opt.gravity[:], model.opt.timestep = scenario.gravity, scenario.time_step
    return model


def _at_rest(scenario: mc.Scenario) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the scenario's robot without contacts and constraints, and its rest stance."""
    model = _compiled(load_spec(scenario.robot), scenario)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return model, data


class Rollout:
    """Robots that fall from the rest stance, by `mujoco.rollout` on threads."""

    def __init__(self, scenario: mc.Scenario, count: int, steps: int, threads: int):
        self.model, rest = _at_rest(scenario)
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        every = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(mujoco.mj_stateSize(self.model, every))
        mujoco.mj_getState(self.model, rest, start, every)
        self.start = np.tile(start, (count, 1))
        self.states = np.empty((count, steps, len(start)))  # allocated once, so that the pages are warm
        self.sensed = np.empty((count, steps, 0))
        self.pool = rollout.Rollout(nthread=threads)

    def run(self) -> None:
        """Run all of the steps once."""
        self.pool.rollout(
            self.model, self.data, self.start, nstep=self.states.shape[1], state=self.states, sensordata=self.sensed
        )


class Warp:
    """The same by `mujoco_warp` (extra `compare`); on a GPU a step is a CUDA graph, on a CPU a sequence of kernels."""

    def __init__(self, scenario: mc.Scenario, count: int):
        import mujoco_warp as mjwarp
        import warp

        warp.config.log_level = warp.LOG_WARNING
        model, start = _at_rest(scenario)
        mujoco.mj_forward(model, start)
        self.model = mjwarp.put_model(model)
        # contacts and constraints are switched off; without room for one constraint the release does not accelerate
        self.data = mjwarp.put_data(model, start, nworld=count, nconmax=0, njmax=1)
        self.synchronize: Callable[[], object] = warp.synchronize
        self.step: Callable[[], object] = lambda: mjwarp.step(self.model, self.data)
        self.step()  # compiles the kernels, which a capture cannot
        if warp.get_device().is_cuda:
            with warp.ScopedCapture() as capture:
                self.step()
            self.step = lambda: warp.capture_launch(capture.graph)

    def run(self, steps: int) -> None:
        """Fall on for some steps, and wait for the last one."""
        for _ in range(steps):
            self.step()
        self.synchronize()
