"""A stored walk worked out again, row by row, in NumPy and MuJoCo's C code: from docs/explanation/, not the package.

Each row starts from the state that the walk has there; the state of the next row is part of what must come out.
"""

import jax
import mujoco
import numpy as np
from scipy.interpolate import CubicHermiteSpline, RegularGridInterpolator
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from mjx_climb.disturbances.link_wrench import LinkWrench
from mjx_climb.hardware.sensors import normal
from mjx_climb.hardware.velocity_commanded import VelocityCommanded as VelocityCommandedDrive
from mjx_climb.robot_import.load import load_model

RELAXATION = 5e-3  # s: dry friction
PLUS_MINUS = np.array([-1, 1])
Z = np.array([0.0, 0.0, 1.0])


def rest_to_rest(u):
    return 3 * u**2 - 2 * u**3


def number(value, otherwise=np.inf):
    return otherwise if value is None else value


def attitude(quaternion):
    return Rotation.from_quat(quaternion, scalar_first=True)


def late(past, delay):
    """Return a signal as it was `delay` steps ago, linear between samples; the first has always been."""
    whole = int(delay + 1e-9)
    new, old = (past[max(len(past) - 1 - age, 0)] for age in (whole, whole + 1))
    return new + max(delay - whole, 0.0) * (old - new)


class Gait:
    """What the gait wants at a step."""

    def __init__(self, walk, feet, base):
        scenario, gait = walk.scenario, walk.scenario.gait
        self.cycle = round(gait.cycle / scenario.time_step)
        self.swing = int(round((1 - gait.duty) * self.cycle, 6))  # limbs in turn never swing together
        self.offset = np.array([round(gait.lift_off[limb] * self.cycle) for limb in walk.limbs])
        self.settling, self.step_height, turn = gait.settling, gait.step_height, Rotation.from_euler("z", gait.heading)
        self.advance, self.feet, self.base = turn.apply([gait.stride, 0, 0]), turn.apply(feet), turn.apply(base)
        self.actual, self.start = gait.base_reference == "actual", None
        given = dict(scenario.ground.footholds.items()) if scenario.ground.footholds is not None else {}
        self.heights = [given.get(limb, (0.0,)) for limb in walk.limbs]
        if (own := scenario.ground.map) is not None:
            cycles = np.arange(len(walk.time) // self.cycle + 2)
            samples, (x, y) = np.load(own.file), own.origin
            axes = (edge + own.resolution * np.arange(n) for edge, n in zip((y, x), samples.shape, strict=True))
            places = (self.feet[:, None] + cycles[:, None] * self.advance)[..., 1::-1]
            self.heights = own.scale * RegularGridInterpolator(tuple(axes), samples)(places)
        self.base = self.base * [1, 1, gait.height]
        self.sway, self.landing = (
            self.swaying(gait, walk.limbs, (self.feet - self.base) * [1, 1, 0]),
            gait.landing_speed,
        )
        self.moves = (1 - gait.settling) * self.swing * scenario.time_step  # s, a foot in a swing
        self.path = gait.step_height * turn.apply(np.moveaxis(walk.parameters.gait.swing_path, 1, 2))

    def swaying(self, gait, limbs, feet):
        """Return the sway over the phase of a cycle: a spline at rest in the middle of each swing, as on the docs."""
        begins = [np.array([gait.lift_off[limb] for limb in limbs]) + n for n in (-2, -1, 0, 1, 2)]
        ends = [begin + 1 - gait.duty for begin in begins]
        knots = np.unique(np.concatenate([begin + (1 - gait.duty) / 2 for begin in begins]).round(12))
        up = np.array([[any(b[k] < t < e[k] for b, e in zip(begins, ends, strict=True)) for k in range(len(limbs))]
                       for t in knots])  # fmt: skip
        points = np.array([gait.sway * feet[~row].mean(0) for row in up])
        return CubicHermiteSpline(knots, points, np.zeros_like(points))

    def height(self, foothold):
        """Return the heights (L,) of the limbs' footholds of these numbers; the last goes on for ever."""
        numbers = np.broadcast_to(foothold, len(self.heights))
        return np.array([own[min(n, len(own) - 1)] for own, n in zip(self.heights, numbers, strict=True)])

    def at(self, step, base):
        """Return which grippers are shut, the ground below the feet, base reference and foot targets in the air."""
        cycle, within = divmod(step, self.cycle)
        since = (within - self.offset) % self.cycle
        shut = since >= self.swing
        ground = self.height(cycle + (within - self.offset >= self.swing / 2))
        old, new = self.height(cycle), self.height(cycle + 1)
        if within == 0 or not self.actual:
            self.start = base - self.sway(0) if self.actual else self.base + cycle * self.advance + old.mean() * Z
        way = self.advance + (new.mean() - old.mean()) * Z
        phase = np.where(shut, 0, np.minimum(since / self.swing / (1 - self.settling), 1))
        feet = self.feet + cycle * self.advance + rest_to_rest(phase)[:, None] * self.advance
        end = np.where(phase < 0.5, old, new)
        top = np.maximum(old, new) + self.step_height
        feet[:, 2] += end + (top - end) * rest_to_rest(np.minimum(2 * phase, 2 - 2 * phase))
        lands = CubicHermiteSpline([self.moves / 2, self.moves], [0, 0], [0, -self.landing])
        feet[:, 2] += np.where(phase > 0.5, lands(phase * self.moves), 0)
        for limb, c in enumerate(2 * phase - 1):
            for k, added in enumerate(self.path[limb]):
                feet[limb] += added * (1 - c**2) ** 3 * c ** (k + np.array([0, 0, 1]))
        swayed = self.start + self.sway(within / self.cycle)
        return shut, ground, swayed + rest_to_rest(within / self.cycle) * way, feet

    def times(self, step):
        """Return how many steps until each gripper opens, and since it shut; a cycle more before its first swing."""
        since = (step - self.offset) % self.cycle
        return np.where(
            since < self.swing, 0, [self.cycle - since, since - self.swing + self.cycle * (step < self.offset)]
        )


class Grips:
    """Springs and dampers between feet and ground."""

    def __init__(self, contact, feet, turned, time_step):
        self.kept = np.exp(-time_step / contact.closing_time) if contact.closing_time else 0.0  # of a gap, in a step
        self.closure, self.pressed = np.ones(len(feet)), np.ones(len(feet), bool)
        self.contact, self.point, limbs = contact, feet.copy(), len(feet)
        self.touched, self.shut = np.ones((2, limbs), bool)
        self.missing, self.held, self.detached = np.zeros((3, limbs), bool)
        self.attitude = turned.copy()

    def act(self, feet, velocity, turned, spin, shut, ground, walked):
        own, before = self.contact, self.detached.copy()
        support, shuts = shut & ~self.detached, np.zeros_like(shut)
        missed, reach = shuts, number(own.capture_distance)
        if np.isfinite(reach):
            shuts = support & ~self.shut
            missed = shuts & (feet[:, 2] - ground > reach)
            self.missing = shut & (self.missing | missed)
            support = support & ~self.missing
        self.shut = shut
        above = feet[:, 2] - ground
        # a foot that is at the ground to rounding may be on either side of it
        touching = support | np.where(np.abs(above) < 1e-14, walked, above <= 0)
        fresh = touching & ~self.touched | shuts
        begins, slow = support & ~self.held, own.closing_time > 0
        self.point[fresh] = np.column_stack([feet[:, :2], np.where(slow & support & (above > 0), feet[:, 2], ground)])[
            fresh
        ]
        for limb in np.flatnonzero(support) if slow else ():
            gap = self.point[limb, 2] - ground[limb]
            if begins[limb]:
                self.closure[limb], self.pressed[limb] = 1.0 - (fresh | ~self.touched)[limb], above[limb] <= 0
                continue
            self.closure[limb] = 1 - (1 - self.closure[limb]) * self.kept
            if gap > 0:
                stalled = above[limb] - number(own.closing_force) / own.stiffness
                self.point[limb, 2] = ground[limb] + max(gap * self.kept, min(gap, stalled))
        self.closure[~support] = 1.0
        self.touched = touching
        share = np.column_stack([self.closure, self.closure, np.where(self.pressed, 1.0, self.closure)])
        force = touching[:, None] * (-own.stiffness * (feet - self.point) - own.damping * share * velocity)
        if np.isfinite(reach):
            force[~support] = np.maximum(force[~support] @ Z, 0)[:, None] * Z
        moment = np.zeros_like(force)
        for limb in np.flatnonzero(support) if own.rotational_stiffness else ():
            if not self.held[limb]:
                self.attitude[limb] = turned[limb]
            twist = self.attitude[limb] @ turned[limb].T
            sine = np.array([twist[2, 1] - twist[1, 2], twist[0, 2] - twist[2, 0], twist[1, 0] - twist[0, 1]]) / 2
            moment[limb] = own.rotational_stiffness * sine - own.rotational_damping * spin[limb]
        self.held = support
        used = support * (force[:, 2] < 0) * np.linalg.norm(force, axis=1) / number(own.holding_limit)
        torn = used > 1
        self.detached = self.detached | torn
        return {
            "grip_point": self.point.copy(), "support": support, "contact": touching, "detached": before,
            "torn_off": torn, "missed": missed, "foot_force": force, "foot_moment": moment, "utilization": used,
        }  # fmt: skip


class Law:
    """The paper's Eqs. 2 and 3 in the ways of docs/explanation/two_readings.md, and pd."""

    def __init__(self, scenario, reference, limbs):
        self.control, self.reference = scenario.control, reference
        self.period = scenario.hardware.control_period or scenario.time_step
        axes = 3 if self.control.controller == "end_effector_admittance" else 6
        names = ("inertia", "damping", "stiffness")
        self.gains = [np.broadcast_to(getattr(self.control, name), 6)[:axes] for name in names]
        self.state = np.zeros((axes, 2)) if axes == 6 else np.zeros((limbs, axes, 2))
        systems = [[[0, 1, 0], [-k / m, -d / m, 1 / m], [0, 0, 0]] for m, d, k in zip(*self.gains, strict=True)]
        self.exact = expm(np.array(systems) * self.period)[:, :2]
        self.deadband = np.broadcast_to(self.control.deadband, 2)
        self.farthest, self.fastest = (
            np.broadcast_to(number(own), 2) for own in (self.control.max_offset, self.control.max_velocity)
        )

    def within(self, state):
        """Return offsets and rates (6, 2) within their bounds: at that of an offset there is no rate outwards."""
        for (offset, rate), far, fast in zip(state.reshape(2, 3, 2).mT, self.farthest, self.fastest, strict=True):
            rate *= min(1.0, fast / max(np.linalg.norm(rate), 1e-300))
            if (length := np.linalg.norm(offset)) >= far:
                rate -= max(rate @ offset, 0.0) * offset / length**2
                offset *= far / length
        return state

    def say(self, position, base, force, wrench, support, known, feet, times):
        """Return where base, its attitude and the feet shall be, and the shift of the base."""
        into, shift, turn = self.reference.inv(), np.zeros(6), Rotation.identity()
        own = np.concatenate([into.apply(wrench[:3]), into.apply(wrench[3:])])
        kind = self.control.controller, self.control.reading
        if kind == ("base_admittance", "virtual_model"):
            parts = zip(own.reshape(2, 3), self.deadband, strict=True)
            felt = np.concatenate([each * (np.linalg.norm(each) >= least) for each, least in parts])
            self.state = self.within(np.matvec(self.exact, np.column_stack([self.state, -felt])))
            shift = self.state[:, 0]
            turn = Rotation.from_rotvec(shift[3:])
        elif kind == ("base_admittance", "measured_pose"):
            where, quaternion, linear, angular = base
            m, d, k = self.gains
            off = 2 * (into * attitude(quaternion)).as_quat(canonical=True)[:3]
            offset = np.concatenate([into.apply(where - position), off])
            rate = np.concatenate([into.apply(linear), into.apply(angular)])
            shift = offset + self.period * rate + self.period**2 * (own - d * rate - k * offset) / m
            half = shift[3:] / 2
            turn = Rotation.from_quat([*half, np.sqrt(1 - half @ half)])
        elif kind[0] == "end_effector_admittance":
            moved = np.matvec(self.exact, np.concatenate([self.state, into.apply(force)[..., None]], axis=-1))
            self.state = np.where(support[:, None, None], moved, 0)
            feet = feet + self.reference.apply(self.state[..., 0])
        return position + self.reference.apply(shift[:3]), self.reference * turn, feet, shift


class Watch:
    """Which force sensors are believed, by the rules of docs/explanation/hardware.md, in a loop of some period in s."""

    def __init__(self, period, limbs):
        self.period, self.share = period, 0.0
        self.heard, self.doubt = np.zeros((limbs, 3)), np.zeros(limbs)

    def listen(self, force, support):
        """Return forces to believe, and whether they can be."""
        silent = ~(np.isfinite(force).all(1) & (np.abs(force).sum(1) > 1e-6))
        for limb in range(len(force)):
            if not silent[limb]:
                self.heard[limb], self.doubt[limb] = force[limb], -0.1
            elif not support[limb]:
                self.heard[limb] = 0.0
        loaded, unheard = np.abs(self.heard).sum() > 1, self.doubt == 0
        self.doubt[silent & support & (loaded | (self.doubt > 0))] += self.period
        believed = (self.doubt < 0) | (unheard & (not loaded))
        self.share = min(max(self.share + (1 if self.lost.any() else -1) * self.period / 0.5, 0), 1)
        known = believed[support].all() and not self.lost.any()
        return self.heard * known, known

    @property
    def lost(self):
        return self.doubt >= 0.1


class Servos:
    """From joint targets to the torques that turn the joints."""

    def __init__(self, scenario, model, joints):
        self.servo, self.step = scenario.hardware.servo, scenario.time_step
        servo, control = self.servo, scenario.control
        self.voltage, self.period = servo.drive == "voltage", round(1 / (number(servo.rate, 1 / self.step) * self.step))
        self.safe_kp = control.kp if control.safe_kp is None else control.safe_kp
        richer = servo.supply_voltage / servo.rated_voltage if servo.supply_voltage else 1.0
        self.kp, self.ki, self.kd = (g * (richer if self.voltage else 1) for g in (control.kp, control.ki, control.kd))
        self.soft_kp, self.safe_kp = self.kp, self.safe_kp * (richer if self.voltage else 1)
        self.stall, self.fast = (number(v) * richer for v in (servo.torque_limit, servo.no_load_speed))
        self.current = number(servo.current_limit)
        own = np.where(model.jnt_actfrclimited[1:], model.jnt_actfrcrange[1:, 1], np.inf).reshape(joints.shape)
        self.limit = np.minimum(own, self.stall)
        if self.voltage:
            self.current = np.minimum(own, self.current)
        self.driven = (model.jnt_group[1:] == 0).reshape(joints.shape)
        self.dry = self.servo.coulomb_friction + model.dof_frictionloss[6:].reshape(joints.shape)
        self.asked, self.bend = [np.zeros_like(joints)], np.zeros_like(joints)
        self.goal, self.speed, self.integral, self.wound = joints, np.zeros_like(joints), np.zeros_like(joints), False

    def stiffen(self, share):
        """Have kp rise to what is safe without a force sensor."""
        self.kp = self.soft_kp + share * max(self.safe_kp - self.soft_kp, 0)

    def follow(self, target, h):
        """Return the servos' goals a period later."""
        way, a = target - self.goal, self.servo.profile_acceleration
        most = np.minimum(np.abs(way) / h, number(self.servo.profile_velocity))
        if a:
            most = np.minimum(most, a * h * (np.sqrt(1 + 8 * np.abs(way) / (a * h * h)) - 1) / 2)
            self.speed = np.clip(np.sign(way) * most, self.speed - a * h, self.speed + a * h)
        else:
            self.speed = np.sign(way) * most
        self.goal = self.goal + h * self.speed
        return self.goal

    def ask(self, target, angles, rates):
        """Return what the loops ask for, where they are evaluated."""
        play, h = self.servo.backlash / 2, self.step * self.period
        error = (self.follow(target, h) if self.servo.profile_velocity else target) - angles
        error = error - np.clip(error, -play, play)
        more = self.integral + h * error
        asked = self.kp * error + self.ki * more - self.kd * rates
        most = self.servo.pwm_limit * self.stall if self.voltage else np.minimum(self.limit, self.current)
        full = (np.abs(asked) > most) & (asked * error > 0)
        self.wound |= (full & (self.ki > 0)).any()
        self.integral = np.where(full, self.integral, more)
        return self.driven * (self.kp * error + self.ki * self.integral - self.kd * rates)

    def volts_of(self, share, rates):
        """Return the voltage at the servos over that of the supply at rest, by V = V_0 - R_0 u (u V - kt w) / R."""
        if not self.servo.supply_resistance:
            return 1.0
        volts = self.servo.supply_voltage
        constant = volts / self.fast  # V s/rad
        own = constant * volts / self.stall
        outer = self.servo.supply_resistance
        return (volts + outer * share * constant * rates / own) / (1 + outer * share**2 / own) / volts

    def bears(self, torque, load, rates):
        """Return what dry friction bears: M6, of which the other models are parts."""
        s = self.servo
        still = np.exp(-((np.abs(rates) / s.stribeck_velocity) ** s.stribeck_exponent))
        found = self.dry + still * s.stribeck_friction
        found = found + np.abs(s.external_load_friction * load - s.load_friction * torque)
        found = found + still * np.abs(s.stribeck_external_load_friction * load - s.stribeck_load_friction * torque)
        drives = (np.sign(load) != np.sign(torque)) & (np.abs(torque) > np.abs(load))
        driven = (np.sign(load) != np.sign(torque)) & (np.abs(torque) < np.abs(load))
        return found + still * (
            drives * s.quadratic_external_load_friction * load**2 + driven * s.quadratic_load_friction * torque**2
        )

    def turn(self, step, target, angles, rates, load):
        """Return the motors' torques, those on the joints, and the armature of joints that stick."""
        h = self.step
        self.asked.append(self.ask(target, angles, rates) if step % self.period == 0 else self.asked[-1])
        torque = late(self.asked, self.servo.delay / h)
        slow = rates / self.fast
        top, bottom = np.minimum(1, 1 - slow), np.minimum(1, 1 + slow)
        most = np.where(np.isfinite(self.limit), self.limit, 0)
        limited = np.clip(torque, -most * np.maximum(bottom, -1), most * np.maximum(top, -1))
        torque = np.where(np.isfinite(self.limit), limited, torque)
        if self.voltage:
            share = np.clip(late(self.asked, self.servo.delay / h) / self.stall, *(self.servo.pwm_limit * PLUS_MINUS))
            volts = self.volts_of(share, rates)
            torque = self.driven * self.stall * (share * volts - rates / self.fast)
        torque = np.clip(torque, -self.current, self.current)
        bears = self.bears(torque, load, rates)
        self.bend = np.clip(self.bend + h * rates / self.servo.presliding, -1, 1)
        ahead = self.bend + (RELAXATION + h) * rates / self.servo.presliding
        armature = np.where(np.abs(ahead) < 1, h * (RELAXATION + h) * bears / self.servo.presliding, 0)
        return torque, torque - bears * np.clip(ahead, -1, 1), armature


class VelocityCommanded:
    """Motors that follow the rates of a manager, by the equations of docs/guides/actuator.md."""

    def __init__(self, drive, scenario, joints):
        self.drive, self.step = drive, scenario.time_step
        self.every = max(round(float(drive.manager_period) / self.step), 1)
        self.error, self.rate = np.zeros_like(joints), np.zeros_like(joints)

    def stiffen(self, share):
        """These have no gains of a joint loop."""

    def turn(self, step, target, angles, rates, load):
        """Return the motors' torques twice, as there is no friction, and the armature h G of those below their limit.

        With it the rate that a motor resists is that after the step: G (command - rate - h acceleration).
        """
        if step % self.every == 0:
            before, self.error = self.error, target - angles
            wanted = self.drive.p * self.error + self.drive.d * (self.error - before) / (self.every * self.step)
            self.rate = np.clip(wanted, *(self.drive.largest_rate * PLUS_MINUS))
        asked = self.drive.velocity_gain * (self.rate - rates)
        torque = np.clip(asked, *(self.drive.torque_limit * PLUS_MINUS))
        return torque, torque, np.where(torque == asked, self.step * self.drive.velocity_gain, 0.0)


def margins(feet, support, com, force, moment, mass, gravity, hold):
    """Return TSM (m) and GIA margin (m/s^2) of one instant."""
    feet = feet[support]
    if len(feet) < 3:
        return 0.0, 0.0
    tumbling, inside = [], []
    for n, a in enumerate(feet):
        b = feet[(n + 1) % len(feet)]
        length = np.linalg.norm(a - b)
        others = [np.cross(a - j, b - j) for k, j in enumerate(feet) if k not in (n, (n + 1) % len(feet))]
        arm = max([0.0, *(np.linalg.norm(n) / length for n in others if n[2] > 0)])
        tumbling.append(hold * arm - (moment @ (a - b) + force @ np.cross(b, a)) / length)
        normal = np.cross(com - a, com - b)
        inside.append((hold * sum(n[2] for n in others) + force @ normal) / (mass * np.linalg.norm(normal)))
    smallest, without_gravity = max(0.0, min(tumbling)), np.inf if min(tumbling) > 0 else 0.0
    return smallest / (mass * gravity) if gravity else without_gravity, max(0.0, min(inside))


class Body:
    """MuJoCo's model of the robot, without its solver."""

    def __init__(self, walk):
        scenario = walk.scenario
        self.model = model = load_model(scenario.robot).__copy__()
        self.as_filed = load_model(scenario.robot).__copy__()
        self.as_filed.opt.gravity[:] = scenario.gravity
        for values in (model.body_mass, model.body_inertia):
            values *= float(walk.parameters.mass_scale)
        model.opt.gravity[:] = scenario.gravity
        model.dof_damping[6:] += scenario.hardware.servo.viscous_friction
        self.armature = model.dof_armature[6:] + scenario.hardware.servo.armature
        self.mass, self.data, self.aim = model.body_mass.copy(), mujoco.MjData(model), mujoco.MjData(model)
        self.limbs, self.shape = model.nsite, (model.nsite, -1)

    def place(self, data, position, quaternion, angles):
        data.qpos[:] = np.concatenate([position, quaternion, angles.ravel()])
        mujoco.mj_fwdPosition(self.model, data)

    def jacobians(self, data):
        found = np.empty((self.limbs, 2, 3, self.model.nv))
        for limb, (linear, angular) in enumerate(found):
            mujoco.mj_jacSite(self.model, data, linear, angular, limb)
        return found

    def felt(self, quaternion, angles, torque):
        """Return the forces on the feet that hold limbs of the file's masses still under their motors' torques."""
        data = mujoco.MjData(self.as_filed)
        data.qpos[:] = np.concatenate([np.zeros(3), quaternion, angles.ravel()])
        mujoco.mj_forward(self.as_filed, data)
        missing = (data.qfrc_bias[6:] - torque.ravel()).reshape(self.shape)
        columns = [np.empty((3, self.model.nv)) for _ in range(self.limbs)]
        for limb, own in enumerate(columns):
            mujoco.mj_jacSite(self.as_filed, data, own, None, limb)
        limbs = [own[:, 6 + 3 * limb : 9 + 3 * limb] for limb, own in enumerate(columns)]
        return np.array([np.linalg.solve(own.T, each) for own, each in zip(limbs, missing, strict=True)])

    def joints_for(self, position, rotation, feet, angles):
        """Return the joint angles, near some, that put feet of three joints each there, by Newton's method."""
        for _ in range(6):
            self.place(self.aim, position, rotation.as_quat(scalar_first=True), angles)
            errors, columns = feet - self.aim.site_xpos, self.jacobians(self.aim)[:, 0, :, 6:]
            own = [columns[limb][:, 3 * limb : 3 * limb + 3] for limb in range(self.limbs)]
            angles = angles + np.array([np.linalg.solve(j, e) for j, e in zip(own, errors, strict=True)])
        return angles

    def touched(self, touch, time):
        """Return the generalised forces (nv,) of a wrench on a link, and force and moment about the base's centre."""
        model, data, found = self.model, self.data, np.zeros(self.model.nv)
        if not touch.start <= time < touch.stop:
            return found, np.zeros(6)
        link = 2 + int(touch.limb) * self.model.njnt // self.limbs + int(touch.link)
        turned = data.xmat[link].reshape(3, 3)
        point, force, moment = data.xpos[link] + turned @ touch.at, touch.force, touch.moment
        if touch.frame == "link":
            force, moment = turned @ force, turned @ moment
        mujoco.mj_applyFT(model, data, force, moment, point, link, found)
        return found, np.concatenate([force, np.cross(point - data.xpos[1], force) + moment])

    def loads(self, held, touch):
        """Return what all but the servos does at the joints: the bias, the forces of the grips, and a touch."""
        mujoco.mj_fwdVelocity(self.model, self.data)
        acting = touch - self.data.qfrc_bias
        for columns, force, moment in zip(
            self.jacobians(self.data), held["foot_force"], held["foot_moment"], strict=True
        ):
            acting = acting + force @ columns[0] + moment @ columns[1]
        return acting[6:].reshape(self.shape)

    def accelerations(self, rotation, torque, held, push, touch, cargo, armature):
        model, data = self.model, self.data
        model.body_mass[1] = self.mass[1] + cargo
        model.dof_armature[6:] = self.armature + armature.ravel()
        data.xfrc_applied[1] = push
        data.qfrc_applied[:] = touch + np.concatenate([np.zeros(6), torque.ravel()])
        for columns, force, moment in zip(self.jacobians(data), held["foot_force"], held["foot_moment"], strict=True):
            data.qfrc_applied += force @ columns[0] + moment @ columns[1]
        mujoco.mj_forward(model, data)
        return data.qacc[:3].copy(), rotation.apply(data.qacc[3:6]), data.qacc[6:].reshape(self.shape).copy()


def windows(scenario, step):
    """Return cargo (kg) and push (6,) at a step."""

    def on(window):
        h = scenario.time_step
        return round(window.start / h) <= step < number(window.stop) / h - 0.5 + 1e-9

    pushes, cargo = scenario.disturbance.pushes, scenario.disturbance.cargo
    push = sum((np.array([*push.force, *push.moment]) for push in pushes if on(push)), np.zeros(6))
    return on(cargo) * cargo.mass, push


def again(walk, law=None):
    """Return the histories of a walk by name, each worked out from the states that it has.

    A law is the scenario's, unless it is given: a class of `tests/oracle_laws.py`, say.
    """
    scenario, h = walk.scenario, walk.scenario.time_step
    sensor, estimate, hardware = scenario.hardware.force_sensor, scenario.hardware.base_estimate, scenario.hardware
    assert scenario.control.integration == "exact"
    body = Body(walk)
    stance = body.model.key_qpos[0]
    reference = Rotation.from_euler("z", scenario.gait.heading) * attitude(stance[3:7])
    angles = stance[7:].reshape(body.shape)
    body.place(body.data, stance[:3], stance[3:7], angles)
    gait = Gait(walk, body.data.site_xpos.copy(), stance[:3])
    _, ground, start, feet = gait.at(0, gait.base + gait.height(0).mean() * Z + gait.sway(0))
    feet = gait.feet + ground[:, None] * Z
    three = angles.shape[1] == 3 and (body.model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE).all()
    angles = body.joints_for(start, reference, feet, angles) if three else angles
    before = said = angles
    still = np.zeros(3)
    after = start, reference.as_quat(scalar_first=True), still, still, angles, np.zeros_like(angles)
    body.place(body.data, *after[:2], angles)
    grips = Grips(scenario.contact, feet, body.data.site_xmat.reshape(-1, 3, 3), h)
    law = Law(scenario, reference, body.limbs) if law is None else law(scenario, reference, body.limbs)
    drive = walk.parameters.drive
    velocity = isinstance(drive, VelocityCommandedDrive)
    servos = VelocityCommanded(drive, scenario, angles) if velocity else Servos(scenario, body.model, angles)
    forces, bases, commands, shares, filtered = [np.zeros_like(feet)], [], [angles], [0.0], np.zeros_like(feet)
    reads = not isinstance(law, Law) or scenario.control.controller != "pd"
    watch = Watch(law.period, body.limbs) if reads and (sensor.resolution or sensor.dead is not None) else None
    known = True
    read, by_law = np.zeros(feet.size + 6), sensor.filtered_by == "law"
    share = 1 - np.exp(-2 * np.pi * (law.period if by_law else h) * number(sensor.filter))
    period, rows, turned_by, drift = round(law.period / h), [], np.zeros_like(angles), np.zeros_like(feet)
    names = [f"base_{name}" for name in ("position", "orientation", "linear_velocity", "angular_velocity")]
    names += ["joint_angles", "joint_rates"]
    for step in range(len(walk.time)):
        row = dict(zip(names, after, strict=True), time=step * h)
        state = [getattr(walk, name)[step].copy() for name in names]
        position, quaternion, linear, angular, angles, rates = state
        rotation = attitude(quaternion)
        body.data.qvel[:] = np.concatenate([linear, rotation.inv().apply(angular), rates.ravel()])
        body.place(body.data, position, quaternion, angles)
        feet, speeds = body.data.site_xpos.copy(), body.jacobians(body.data) @ body.data.qvel
        turned = body.data.site_xmat.reshape(-1, 3, 3)
        row |= {"foot_position": feet, "foot_velocity": speeds[:, 0]}
        shut, ground, wanted, targets = gait.at(step, position)
        held = grips.act(feet, speeds[:, 0], turned, speeds[:, 1], shut, ground, walk.contact[step])
        targets = np.where(shut[:, None], held["grip_point"], targets)
        gap = np.where(shut & (gait.times(step)[1] == 0), np.maximum(feet[:, 2] - ground, 0), 0)
        lever, moments = feet - position, held["foot_moment"].sum(0)

        def wrench_of(force, lever=lever, moments=moments):
            return np.concatenate([force.sum(0), np.cross(lever, force).sum(0) + moments])

        acting = held["foot_force"]
        if sensor.source == "joint_effort":
            acting = np.where(held["support"][:, None], body.felt(quaternion, angles, turned_by), 0.0)
        forces.append(acting * (Z if sensor.axes == "z" else 1.0))
        drift = (
            drift + sensor.drift * h**0.5 * noise(hardware.seed, step, 2000 + np.arange(drift.size)).reshape(3, -1).T
        )
        force = late(forces, sensor.delay / h) + sensor.bias + drift
        if sensor.noise:
            force = force + sensor.noise * noise(hardware.seed, step, np.arange(force.size)).reshape(3, -1).T
        if sensor.resolution:
            force = sensor.resolution * np.round(force / sensor.resolution)
        if not by_law:
            force = filtered = filtered + share * (force - filtered)
        instants = dict(sensor.dead.items()) if sensor.dead is not None else {}
        dead = [step * h > instants.get(limb, np.inf) - h / 2 for limb in walk.limbs]
        force = np.where(np.array(dead)[:, None], 0.0, force)
        if watch is not None and step % period == 0:
            force, known = watch.listen(force, held["support"])
        sampled = np.concatenate([force.ravel(), known * wrench_of(force)])
        if not by_law or step % period == 0:
            read = read + share * (sampled - read) if by_law else sampled
        bases.append(np.concatenate(state[:4]))
        base = np.split(late(bases, estimate.delay / h), [3, 7, 10])
        if estimate.position_noise or estimate.velocity_noise:
            drawn = noise(hardware.seed, step, 1000 + np.arange(6))
            base[0] = base[0] + estimate.position_noise * drawn[:3]
            base[2] = base[2] + estimate.velocity_noise * drawn[3:]
        if step % period == 0:
            sensed = read[:-6].reshape(-1, 3), read[-6:], held["support"], known
            command = law.say(wanted, base, *sensed, targets, h * gait.times(step))
            before = said
            if three:
                said = body.joints_for(*command[:3], said)
            else:  # there may be other postures, or none: the walk's own
                said = walk.joint_targets[step]
        body.place(body.aim, command[0], command[1].as_quat(scalar_first=True), said)
        row["reachable"] = np.linalg.norm(body.aim.site_xpos - command[2], axis=1) < 1e-4
        into = (step % period + 1) / period if hardware.interpolation == "linear" else 1.0
        commands.append(before + into * (said - before))
        goal = late(commands, hardware.command_delay / h)
        shares.append(0.0 if watch is None else watch.share)
        servos.stiffen(late(shares, hardware.command_delay / h))
        touch, by_touch = np.zeros(body.model.nv), np.zeros(6)
        for each in walk.parameters.disturbances:
            if not isinstance(each, LinkWrench):
                continue
            more = body.touched(each, (step + 0.5) * h)
            touch, by_touch = touch + more[0], by_touch + more[1]
        torque, turning, armature = servos.turn(step, goal, angles, rates, body.loads(held, touch))
        turned_by = torque
        cargo, push = windows(scenario, step)
        body.model.body_mass[1] = body.mass[1] + cargo
        mass = body.model.body_mass.sum()
        com = body.model.body_mass @ body.data.xipos / mass
        wrench = wrench_of(held["foot_force"])
        net = wrench + push + by_touch
        limit = number(scenario.contact.holding_limit, 0.0)
        pull, moment = np.linalg.norm(scenario.gravity), net[3:] + np.cross(position, net[:3])
        tsm, gia = margins(feet, held["support"], com, net[:3], moment, mass, pull, limit)
        found = body.accelerations(rotation, turning, held, push, touch, cargo, armature)
        linear, angular, rates = (v + h * a for v, a in zip((linear, angular, rates), found, strict=True))
        quaternion = (Rotation.from_rotvec(h * angular) * rotation).as_quat(scalar_first=True)
        quaternion *= np.sign(quaternion @ state[1])
        after = position + h * linear, quaternion, linear, angular, angles + h * rates, rates
        rows.append(row | held | {
            "base_linear_acceleration": found[0], "base_angular_acceleration": found[1],
            "joint_accelerations": found[2], "joint_targets": goal, "joint_torque": torque, "foot_target": command[2],
            "sensor_lost": np.zeros(body.limbs, bool) if watch is None else watch.lost,
            "stands": np.zeros(body.limbs, bool), "grip_gap": gap,
            "base_reference": wanted, "base_displacement": command[3],
            "base_wrench": wrench, "push": push + by_touch, "cargo_mass": cargo, "center_of_mass": com, "tsm": tsm,
            "gia_margin": gia, "ground_normal": np.tile(Z, (body.limbs, 1)),
        })  # fmt: skip
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def assert_is(walk, law=None):
    """Assert that every history of a walk is what comes out again: to 5e-12 of its largest value, or of one."""
    found = again(walk, law)
    # rounding decides whether such a force is a pull
    none = np.linalg.norm(found["foot_force"], axis=2) < 1e-9
    found["utilization"] = np.where(none, walk.utilization, found["utilization"])
    for name, expected in found.items():
        size = np.abs(expected[np.isfinite(expected)]).max(initial=1.0)
        if name == "utilization":  # the norm of three forces, each as exact as a force is, over their limit
            force = np.abs(found["foot_force"]).max(initial=1.0)
            size = max(size, 3**0.5 * force / number(walk.scenario.contact.holding_limit))
        np.testing.assert_allclose(getattr(walk, name), expected, rtol=0, atol=5e-12 * size, err_msg=name)


def noise(seed, step, channels):
    """Return the package's own noise, of which other tests know that it is white."""
    return np.asarray(_normal(np.asarray(float(seed)), np.asarray(step), channels, np.dtype(float)))


_normal = jax.jit(normal, static_argnums=3)


def judged(walk):
    """Return the metrics of a walk that stayed finite, from its histories."""
    scenario, model = walk.scenario, load_model(walk.scenario.robot)
    size = np.linalg.norm(walk.foot_force, axis=2)
    pulling = walk.support & (walk.foot_force[..., 2] < 0)
    ahead = [np.cos(scenario.gait.heading), np.sin(scenario.gait.heading)]
    travel = (walk.base_position[-1, :2] - walk.base_position[0, :2]) @ ahead
    mass = model.body_mass.sum() * float(walk.parameters.mass_scale) + walk.cargo_mass.max()
    weight = mass * np.linalg.norm(scenario.gravity)
    work = scenario.time_step * np.abs(walk.joint_torque * walk.joint_rates).sum()
    lower, upper = (model.jnt_range[1:, side].reshape(size.shape[1], -1) for side in (0, 1))
    torn = np.argwhere(walk.torn_off)
    return {
        "peak_foot_force": size.max(), "force_variation": np.abs(np.diff(size.max(1))).sum(),
        "peak_pull_force": np.where(pulling, size, 0).max(), "peak_utilization": walk.utilization.max(),
        "peak_joint_torque": np.abs(walk.joint_torque).max(),
        "cost_of_transport": work / (weight * abs(travel)) if weight else None, "travel": travel,
        "base_deviation": np.linalg.norm(walk.base_position - walk.base_reference, axis=1).max(),
        "min_tsm": walk.tsm.min(), "min_gia_margin": walk.gia_margin.min(),
        "joint_limit_margin": np.minimum(walk.joint_angles - lower, upper - walk.joint_angles).min(),
        "detached_at": walk.time[torn[0, 0]] if len(torn) else None,
        "detached_limb": walk.limbs[torn[0, 1]] if len(torn) else None, "missed_grips": walk.missed.sum(),
        "stands_at": None, "diverged": False,
    }  # fmt: skip
