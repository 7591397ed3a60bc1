"""The walks that are timed: of the paper's case 1.2, by the calls that a user makes."""

from collections.abc import Callable

import numpy as np

import mjx_climb as mc

TIME_STEP = 0.001  # s


def scenario(steps: int) -> mc.Scenario:
    """Return so many steps of the paper's case 1.2 (lunar gravity, base admittance), its cargo on from the start."""
    changes = {"duration": steps * TIME_STEP, "time_step": TIME_STEP, "disturbance.cargo": {"mass": 1.0, "start": 0.0}}
    return mc.Scenario(gravity=(0.0, 0.0, -1.635)).with_overrides(changes)


def gains(batch: int) -> dict[str, np.ndarray]:
    """Return the gains (batch, 6) of a sweep over stiffness."""
    stiffness = np.geomspace(1e3, 1e5, batch)[:, None] * np.ones(6)
    return {"inertia": np.ones((batch, 6)), "damping": np.full((batch, 6), 1e3), "stiffness": stiffness}


def walk(batch: int, steps: int, engine: str) -> Callable[[], object]:
    """Return a function that walks a batch by `mjx_climb.rollout_metrics`, as a sweep does."""
    case, values = scenario(steps), mc.Gains(**gains(batch))
    return lambda: mc.rollout_metrics(case, values, dtype=np.float32, engine=engine)


def adjoint(batch: int, steps: int, engine: str) -> Callable[[], object]:
    """Return a function that takes the gradient of a metric by all gains in reverse mode."""
    simulation, values = mc.Simulation(scenario(steps), engine=engine), mc.Gains(**gains(batch))
    return lambda: simulation.vjp(values, {"force_variation": np.ones((1, batch))})


def gradient(tangents: int, batch: int, steps: int, engine: str) -> Callable[[], object]:
    """Return the same with `tangents` of every metric, by log damping and log stiffness: 2 (of all axes), or 12."""
    simulation, values = mc.Simulation(scenario(steps), engine=engine), gains(batch)
    shifts = np.kron(np.eye(2), np.ones((1, 6))) if tangents == 2 else np.eye(12)
    along = {"damping": shifts[:, None, :6] * values["damping"], "stiffness": shifts[:, None, 6:] * values["stiffness"]}
    return lambda: simulation.jvp(mc.Gains(**values), along)
