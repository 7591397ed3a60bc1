"""Physics and derivatives on this machine, against values stored with the package.

Compared are the metrics of half a second's walk under Eq. 3 (two swings, two touchdowns, cargo, a push, a slope)
and their forward derivative by stiffness and damping, in double precision; and the accelerations of one state by both
engines and by MuJoCo's C code. `python -m tuning.benchmarks.self_check` stores the values anew.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_climb.functions import forward_dynamics
from mjx_climb.mujoco_import import mujoco
from mjx_climb.parameter_types import Gains
from mjx_climb.physics.equations_of_motion import ENGINES
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import load_model
from mjx_climb.scenario.model import SHIPPED_LIMBS, Scenario
from mjx_climb.simulation import Simulation
from mjx_climb.trajectory import named

MUJOCO = "mujoco"  # among the engines: its C code
STORED = Path(__file__).with_name("self_check.json")

# Relative. Another order of the same arithmetic (the other engine all through the walk) moves the values by 3e-14 at
# most, so other processors stay far below this; a mass or a gain that is off by a millionth moves them far above.
TOLERANCE = 1e-9

INERTIA, DAMPING, STIFFNESS = 1.0, 100.0, 3000.0
SCENARIO = Scenario().with_overrides(
    {
        "duration": 0.5,
        "gait.cycle": 1.0,
        "gravity": (0.3, -0.2, -1.6),
        "control": {"inertia": INERTIA, "damping": DAMPING, "stiffness": STIFFNESS},
        "disturbance.cargo": {"mass": 0.5, "start": 0.1},
        "disturbance.pushes": [{"force": (-2.0, 1.0, 0.0), "start": 0.2, "stop": 0.3}],
    }
)


Value = float | str | bool | None


class Deviation(NamedTuple):
    """The value furthest from the stored one: by how much, relative (infinite where either is no number), and which."""

    size: float
    name: str
    value: Value
    stored: Value


def measure() -> dict[str, dict[str, Value]]:
    """Return the values on this machine: `walk` and `gradient` by metric, and accelerations by engine.

    The gradient is the derivative by the logarithm of damping and stiffness together. Accelerations: base linear m/s^2,
    base angular rad/s^2, joints rad/s^2, world axes.
    """
    gains = Gains(np.full(6, INERTIA), np.full(6, DAMPING), np.full(6, STIFFNESS))
    # the derivative by a logarithm is that along the gain itself
    along = {"damping": np.full((1, 6), DAMPING), "stiffness": np.full((1, 6), STIFFNESS)}
    values, tangents = Simulation(SCENARIO).jvp(gains, along, dtype=np.float64)
    walk = named({name: value.item() for name, value in values.items()}, SHIPPED_LIMBS)
    gradient = {name: tangents[name].item() for name, value in walk.items() if type(value) is float}
    return {"walk": walk, "gradient": gradient, **_accelerations()}


def deviations(
    measured: Mapping[str, Mapping[str, Value]], stored: Mapping[str, Mapping[str, Value]]
) -> dict[str, Deviation]:
    """Return for each part of `measure` the value that is furthest from the stored one, of those that are stored."""
    found = {}
    for part, values in measured.items():
        kept = stored.get(part, stored["acceleration"])
        pairs = {name: (values.get(name), value) for name, value in kept.items()}
        each = [Deviation(_distance(*pair), name, *pair) for name, pair in pairs.items()]
        found[part] = max(each, key=lambda deviation: deviation.size)
    return found


def load() -> dict[str, dict[str, Value]]:
    """Return the stored values: `walk`, `gradient` and `acceleration`, which is MuJoCo's."""
    values: dict[str, dict[str, Value]] = json.loads(STORED.read_text())
    return values


def _distance(value: Value, stored: Value) -> float:
    if isinstance(value, float) and isinstance(stored, float) and math.isfinite(value) and math.isfinite(stored):
        return abs(value - stored) / max(abs(stored), 1e-300)
    return 0.0 if type(value) is type(stored) and value == stored else math.inf


def _accelerations() -> dict[str, dict[str, float]]:
    """Return the accelerations of a state without pattern by engine, and by MuJoCo's C code, for base and joints."""
    angles, rates, torque, foot_force, wrench, velocity, orientation, _ = np.split(
        np.sin(np.arange(1.0, 63.0) ** 2), np.cumsum([12, 12, 12, 12, 6, 3, 4])
    )
    position, orientation = np.array([0.1, -0.2, 0.3]), orientation / np.linalg.norm(orientation)
    spin, rates, foot_force, wrench = velocity[::-1].copy(), 5 * rates, 10 * foot_force.reshape(4, 3), 5 * wrench
    found = {}
    with jax.enable_x64(True):
        state = State(*map(jnp.asarray, (position, orientation, velocity, spin, angles, rates)))
        for engine in sorted(ENGINES):
            result = forward_dynamics(state, torque, foot_force, wrench, 0.0, engine=engine)
            found[engine] = np.concatenate([result.base_linear, result.base_angular, result.joints])
    model = load_model("hubrobo_v3_2")
    data, rotation = mujoco.MjData(model), np.empty((3, 3))
    mujoco.mju_quat2Mat(rotation.reshape(9), orientation)
    data.qpos[:] = np.concatenate([position, orientation, angles])
    data.qvel[:] = np.concatenate([velocity, rotation.T @ spin, rates])  # the base's spin in its own axes
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for site, force in enumerate(foot_force):
        body = model.site_bodyid[site]
        mujoco.mj_applyFT(model, data, force, np.zeros(3), data.site_xpos[site], body, data.qfrc_applied)
    data.qfrc_applied[6:] += torque
    data.xfrc_applied[1] = wrench
    mujoco.mj_forward(model, data)
    found[MUJOCO] = np.concatenate([data.qacc[:3], rotation @ data.qacc[3:6], data.qacc[6:]])
    names = [f"base {kind}{axis}" for kind in ("", "r") for axis in "xyz"]
    names += [f"{limb} {link}" for limb in SHIPPED_LIMBS for link in ("coxa", "femur", "tibia")]
    return {engine: dict(zip(names, values.tolist(), strict=True)) for engine, values in found.items()}


if __name__ == "__main__":
    from mjx_climb.files.dataset import write_text_atomically

    found = measure()
    kept = {"walk": found["walk"], "gradient": found["gradient"], "acceleration": found[MUJOCO]}
    write_text_atomically(STORED, json.dumps(kept, indent=1) + "\n")
