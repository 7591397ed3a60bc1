"""Short walks of unusual robots: together they give every value of every shipped component another than its default."""

from pathlib import Path

import numpy as np

import mjx_climb as mc
from mjx_climb.control import shipped
from mjx_climb.physics.contact.polyhedron import microspines
from tests.robot import climbers

SHORT = {
    "duration": 0.4, "gravity": [0.5, -0.3, -1.5],
    "gait": {"cycle": 0.2, "stride": 0.012, "step_height": 0.006, "heading": 0.3},
    "contact": {"stiffness": 6e3, "damping": 25.0, "holding_limit": 25.0},
    "control": {"kp": 40.0, "kd": 0.25},
}  # fmt: skip
HOLDS = {
    "time_step": 5e-4,
    "gait.planning_period": 0.01,
    "gait.stride": 0.03,
    "gravity": [0.4, 0.1, -1.3],
    "gait.cycle": 1.0,
    "duration": 0.75,
    "contact.stiffness": 4e3,
    "control.kp": 30.0,
}
SPINES = {name: value.tolist() for name, value in microspines(1.2, 60.0, 0.4, 12.5).items()}


def robot(folder: Path, limbs: int = 4, joints: int = 3, attributes: str = "") -> dict[str, object]:
    """Return the sections of a robot of one's own, whose file is written."""
    file = folder / "climber.xml"
    file.write_text(climbers.mjcf(limbs, joints, attributes=attributes))
    return climbers.config(file, limbs, joints)


def height_map(folder: Path) -> dict[str, object]:
    """Return the section of a wavy height map, whose file is written."""
    x, y = np.linspace(-0.5, 0.7, 41), np.linspace(-0.5, 0.5, 31)
    np.save(folder / "map.npy", np.sin(9 * x) * np.cos(7 * y)[:, None] + 0.3 * x)
    return {"file": str(folder / "map.npy"), "resolution": 0.03, "origin": [-0.5, -0.5], "scale": 0.004}


def held_map(folder: Path) -> dict[str, object]:
    """Return the section of that map, two thirds of which can be held."""
    rows, columns = np.indices((31, 41))
    np.save(folder / "mask.npy", ((rows + 2 * columns) % 3 > 0).astype(float))
    return height_map(folder) | {"mask": str(folder / "mask.npy")}


def swing_file(folder: Path) -> dict[str, object]:
    """Return the section of a published swing, whose control points are written."""
    x = [0.0, 0.0, 0.1, 0.4, 0.8, 1.0, 1.0]
    z = [0.0, 0.2, 0.7, 1.0, 0.6, 0.1, 0.0]
    rows = (x, [0.05 * np.sin(3 * value) for value in x], z)
    text = "\n".join(" ".join(f"{0.04 * value:.9f}" for value in row) for row in rows)
    (folder / "swing.txt").write_text(text)
    return {"file": str(folder / "swing.txt")}


GENTLE = {"damping": [300.0, 200.0, 400.0, 4.0, 3.0, 5.0], "stiffness": [2e3, 3e3, 4e3, 40.0, 60.0, 50.0]}
WALKS = {  # the law, its values, and changes of the scenario, perhaps by a folder for files
    "gripper on uneven ground, noisy sensors": (None, {}, {
        "contact": {
            "stiffness": 5e3, "damping": 30.0, "rotational_stiffness": 3.0, "rotational_damping": 0.02,
            "capture_distance": 2e-3, "closing_time": 0.01, "closing_force": 1.5, "holding_limit": 18.0,
        },
        "gait": {
            "cycle": 0.2, "stride": 0.012, "step_height": 0.006, "heading": 0.5, "duty": 0.78, "settling": 0.2,
            "height": 0.95, "sway": 0.3, "landing_speed": 0.04, "sequence": ["RF", "LH", "LF", "RH"],
        },
        "ground.footholds": {"LF": [0.0, 0.001, 0.002], "LH": [0.0, -0.001], "RH": [0.002, 0.0]},
        "control": {
            "inertia": [1.0, 1.2, 1.4, 0.02, 0.03, 0.04], **GENTLE, "deadband": [0.2, 0.02],
            "max_offset": [4e-3, 0.05], "max_velocity": [0.03, 0.4], "kp": 45.0, "kd": 0.3, "ki": 20.0,
        },
        "hardware": {
            "control_period": 0.002, "command_delay": 0.0017, "interpolation": "linear", "seed": 7,
            "force_sensor": {
                "delay": 0.0034, "noise": 0.05, "bias": 0.3, "drift": 0.4, "resolution": 0.01, "filter": 60.0,
            },
            "servo": {
                "torque_limit": 0.6, "no_load_speed": 6.0, "armature": 0.002, "coulomb_friction": 0.01,
                "viscous_friction": 0.01, "load_friction": 0.1, "external_load_friction": 0.05,
                "stribeck_friction": 0.01, "stribeck_load_friction": 0.07, "stribeck_external_load_friction": 0.03,
                "stribeck_velocity": 0.5, "stribeck_exponent": 0.8, "presliding": 8e-4, "backlash": 0.001,
                "delay": 0.0007,
            },
        },
        "disturbance": {
            "cargo": {"mass": 0.5, "start": 0.05, "stop": 0.22},
            "pushes": [{"force": [2.0, -1.0, 1.5], "moment": [0.1, -0.2, 0.15], "start": 0.1, "stop": 0.2}],
        },
    }),
    "uncertain grippers, swings that disturb little": (None, {}, {
        "control": {
            "controller": "end_effector_admittance", "inertia": 0.8, "damping": 120.0, "stiffness": 1500.0,
            "integration": "semi_implicit", "deadband": 0.1, "max_offset": 6e-3, "max_velocity": 0.05, "kp": 42.0,
        },
        "contact": {
            "kind": "uncertain", "stiffness": 5e3, "damping": 35.0, "holding_limit": 14.0, "spread": 0.4,
            "tested_pull": 13.0, "retry_steps": 9.0, "tries": 2.0, "seed": 11.0, "capture_distance": 3e-3,
        },
        "gait": {
            "cycle": 0.2, "stride": 0.012, "step_height": 0.006, "swing": "low_reaction",
            "phases": {"LH": 0.02, "LF": 0.27, "RH": 0.52, "RF": 0.75},
            "waiting": {"waits": True, "retries": 2, "other_holds": 1, "reach": 0.004},
        },
        "hardware.force_sensor.dead": {"LH": 0.0, "RF": 0.15},
        "control.safe_kp": 60.0,
        "disturbance.others": [
            {"kind": "link_wrench", "limb": 1, "link": 2, "force": [1.0, -0.7, 0.4], "moment": [0.02, 0.01, -0.03],
             "at": [0.03, -0.01, 0.02], "start": 0.05, "stop": 0.15},
            {"kind": "link_wrench", "limb": 3, "link": 1, "force": [-0.6, 0.5, 0.3], "moment": [0.01, -0.02, 0.01],
             "at": [0.01, 0.02, 0.01], "start": 0.1, "stop": 0.3, "frame": "link"},
        ],
    }),
    "microspines on a truss, motors that follow rates": (None, {}, HOLDS | {
        "control.controller": "pd", "duration": 0.3,
        "contact": {"kind": "polyhedron", "stiffness": 4e3, "damping": 30.0, "only_pulled": True, **SPINES},
        "gait.footholds": {"kind": "climblab", "stride_cap": 0.06, "reach_a_stride_on": True},
        "gait.order": "free", "gait.waiting.waits": False,
        "ground.holds": {
            "truss": {"bay": 0.1, "depth": 0.05, "pitch": 0.012, "corner": [-0.4, -0.3], "size": [1.2, 0.6]},
            "limit": 45.0, "spread": 0.15, "seed": 3, "spacing": 0.005, "turn": [0.02, -0.03, 0.1],
            "polyhedron": {"matrix": [[0, 0, -1], [1, 0, -0.4], [-1, 0, -0.4], [0, 1, -0.4], [0, -1, -0.4]],
                           "bound": [1.0, 0.7, 0.6, 0.8, 0.5]},
        },
        "hardware.servo": {
            "kind": "velocity", "p": 40.0, "d": 0.2, "manager_period": 0.003, "velocity_gain": 4.0,
            "largest_rate": 5.0, "armature": 0.002, "torque_limit": 2.0,
        },
    }),
    "measured pose on a height map, servos on a voltage": (None, {}, lambda folder: {
        "ground.map": height_map(folder), "gait.base_reference": "actual", "gait.duty": 0.8,
        "control": {
            "reading": "measured_pose", "inertia": 1.5, "damping": 300.0, "stiffness": [2e4, 3e4, 2e4, 80, 90, 70],
            "kp": 60.0, "kd": 0.3, "ki": 30.0,
        },
        "hardware": {
            "control_period": 0.004, "interpolation": "hold", "seed": 5,
            "force_sensor": {"filter": 80.0, "filtered_by": "law", "axes": "z", "noise": 0.02},
            "base_estimate": {"delay": 0.0025, "position_noise": 1e-4, "velocity_noise": 1e-3},
            "servo": {
                "drive": "voltage", "torque_limit": 0.9, "no_load_speed": 6.0, "pwm_limit": 0.8, "rate": 500.0,
                "rated_voltage": 12.0, "supply_voltage": 10.5, "profile_velocity": 1.5, "profile_acceleration": 60.0,
                "supply_resistance": 4.0, "current_limit": 0.7, "armature": 0.002, "coulomb_friction": 0.005,
                "viscous_friction": 0.01, "quadratic_load_friction": 0.3, "quadratic_external_load_friction": 0.2,
            },
        },
    }),
    "load transfer that recovers on rock": ("LoadTransfer+Recovering", {
        "normal_damping": 150.0, "tangential_damping": 6e3, "leak": 0.6, "leveling": 3.0, "unloading": 0.05,
        "loading": 0.04, "landing": 0.6, "pull_limit": 1.1, "recovery_shift": 0.004, "recovery_utilization": 0.3,
        "recovery_landing_time": 0.12, "recovery_rest_time": 0.06, "recovery_take_over": 0.5,
        "recovery_return_time": 0.1,
    }, HOLDS | {
        "gravity": [-0.9, 0.2, -0.8], "gait.duty": 0.8, "gait.stride": 0.02,
        "gait.footholds": {"kind": "best_margin", "distance_weight": 2.0},
        "control.recovery": {"margin": 0.6, "lead_time": 0.01, "reach": 0.02},
        "ground.holds": {
            "rock": {"density": 3000.0, "roughness": 0.004, "wavelength": 0.2, "corner": [-0.4, -0.35],
                     "size": [1.0, 0.7]},
            "limit": 15.0, "spread": 0.3, "seed": 2,
        },
        "disturbance.pushes": [{"force": [-1.5, 0.8, 1.0], "start": 0.32, "stop": 0.4}],
    }),
    "planned transfer of six limbs, forces by efforts": ("PlannedTransfer", {
        "load": 0.9, "sinking": 2e-4, "gravity": 0.7, "leak": 0.5, "leveling": 2.0, "unloading": 0.02,
        "loading": 0.03, "landing": 0.8, "normal_damping": 80.0, "tangential_damping": 4e3, "pull_limit": 0.8,
    }, lambda folder: robot(folder, 6, 3, 'damping="0.02" armature="0.001" frictionloss="0.004"') | {
        "time_step": 0.0005, "duration": 0.3, "contact.stiffness": 2e3, "gait.cycle": 0.15, "gait.duty": 0.75,
        "gait.sequence": [["limb0", "limb3"], ["limb1", "limb4"], ["limb2", "limb5"]],
        "gait.stride": 0.01, "control.kp": 30.0, "disturbance.cargo": {"mass": 0.3, "start": 0.05},
        "hardware.force_sensor": {"source": "joint_effort", "delay": 0.0015, "drift": 0.2},
    }),
    "ClimbSDK's law on a pipe": ("ClimbSDK", {"force_gain": 6e-4, "body_gain": 0.2, "force_cost": 0.4}, HOLDS | {
        "gait.footholds": "nearest", "gait.height": 0.97,
        "ground.holds": {
            "pipe": {"radius": 0.4, "around": 180, "pitch": 0.012, "corner": [-0.4, -0.4], "size": [1.2, 0.8]},
            "at": [0.0, 0.01, 0.002], "count": 20000,
        },
        "hardware.force_sensor.bias": -0.2, "hardware.base_estimate.delay": 0.002,
    }),
    "foot offsets and internal forces on a wall": ("FootOffsets+InternalForce", {
        "outward": 6e-4, "upward": -4e-4, "onward": 5e-4, "damping": [2e3, 3e3, 2.5e3], "stiffness": [9e3, 8e3, 1e4],
    }, HOLDS | {
        "gait.footholds": "farthest", "gait.settling": 0.15, "gait.cycle": 2.0, "gait.stride": 0.015,
        "ground.holds": {
            "wall": {"pitch": 0.014, "filled": 0.8, "height": 0.003, "tilt": 0.05, "corner": [-0.4, -0.4],
                     "size": [1.1, 0.8]},
            "limit": 17.0, "seed": 4,
        },
        "contact.capture_distance": 4e-3,
    }),
    "gains by phase along way points on rails": ("EndEffectorAdmittance@damping,stiffness,kp", {
        "damping_in_swing": 900.0, "damping_before_lift_off": 150.0, "damping_after_touchdown": 80.0,
        "damping_standing": 200.0, "stiffness_in_swing": 4e3, "stiffness_before_lift_off": 1e3,
        "stiffness_after_touchdown": 2e3, "stiffness_standing": 3e3, "kp_in_swing": 0.8, "kp_before_lift_off": 1.2,
        "kp_after_touchdown": 0.7, "inertia": 0.5, "phase_time": 0.05, "phase_ramp": 0.02,
    }, HOLDS | {
        "gait.footholds": {"kind": "least_use", "distance_weight": 3.0},
        "gait.way_points": [[0.03, 0.02], [0.05, -0.01]],
        "gait.order": "free", "gait.stride": 0.02,
        "ground.holds": {"handrails": {"rails": 45, "pitch": 0.013, "corner": [-0.4, -0.4], "size": [1.1, 0.8]},
                         "limit": 10.0},
    }),
    "a published swing of knees on springs": ("VirtualModelAdmittance@damping", {
        "damping_in_swing": GENTLE["damping"], "damping_before_lift_off": 200.0, "damping_after_touchdown": 100.0,
        "damping_standing": 400.0, "stiffness": GENTLE["stiffness"], "inertia": 0.7, "phase_time": 0.03,
    }, lambda folder: robot(folder, 4, 4) | {
        "robot.springs": {f"L{n}_3": {"stiffness": 4.0, "damping": 0.02, "rest": -0.6} for n in range(4)},
        "gait.swing_file": swing_file(folder), "gait.height": 1.02, "time_step": 0.0005, "duration": 0.3,
        "contact.stiffness": 2e3, "gait.cycle": 0.15, "control.kp": 30.0, "hardware.servo.torque_limit": 2.0,
    }),
    "held places of a map, a robot that leans": (None, {}, lambda folder: HOLDS | {
        "ground.holds": {"map": held_map(folder), "limit": 12.0}, "gait.footholds": "best_margin",
        "control": {"controller": "pd", "kp": 28.0, "kd": 0.2}, "contact.holding_limit": 9.0,
        "gait.waiting": {"waits": True, "retries": 1, "other_holds": 3, "reach": 0.02},
        "hardware.servo": {"torque_limit": 0.8, "current_limit": 0.5, "rated_voltage": 12.0, "supply_voltage": 13.0},
    }),
}  # fmt: skip


def scenario_of(name: str, folder: Path) -> mc.Scenario:
    """Return the scenario of a walk, whose files are written to a folder."""
    changes = WALKS[name][2]
    made = dict(changes(folder) if callable(changes) else changes)
    whole = {key: made.pop(key) for key in ("robot", "gait")} if "robot" in made else {}
    short = {**SHORT, "gait": SHORT["gait"] | whole.get("gait", {})} | made
    return mc.Scenario.model_validate(whole).with_overrides(short)


def walked(name: str, folder: Path) -> mc.Trajectory:
    """Return the walk of a name, whose files are written to a folder."""
    law, gains, _ = WALKS[name]
    return mc.rollout(scenario_of(name, folder), gains or None, law=None if law is None else shipped(law))
