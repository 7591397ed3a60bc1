"""Gradients of metrics by `Simulation.vjp` and by `jax.grad`, against tangents in forward mode."""

import numpy as np
import pytest

import mjx_climb as mc

ROBOTS = 2
PUSH = {"start": 0.01, "stop": 0.04, "force": [3.0, 0.0, 1.0], "moment": [0.0, 0.5, 0.0]}
SHORT = {"duration": 0.06, "gait.cycle": 0.06, "gait.stride": 0.005, "gait.step_height": 0.002}
HARDWARE = {"hardware.control_period": 0.004, "hardware.command_delay": 0.004, "hardware.servo.armature": 0.01}
CLOSES = {"contact.closing_time": 0.01, "contact.closing_force": 5.0, "contact.capture_distance": 0.004}
# by name: the law, and what else is not the case's own
WALKS = {
    "pd": {},
    "pd on hardware": HARDWARE,
    "virtual_model": {"disturbance.cargo": {"mass": 0.5, "start": 0.02}},
    "virtual_model with grips that close": {"gait.cycle": 0.3, **CLOSES},
    "measured_pose": {"disturbance.pushes": [PUSH], "gait.base_reference": "actual"},
    "end_effector": {"ground.footholds": {"LF": [0.0, 0.02], "RH": [0.015, 0.0, 0.03]}, "gait.swing": "low_reaction"},
    "measured_pose of three cycles": {"gait.cycle": 0.02, "contact.holding_limit": 4.0},
}
QUICKEST, *OTHERS = WALKS
NAMES = [pytest.param(QUICKEST, marks=pytest.mark.slow), *(pytest.param(n, marks=pytest.mark.nightly) for n in OTHERS)]


def gains_of(law):
    spread = np.linspace(1.0, 1.2, ROBOTS)
    whole = {"kp": 50.0 * spread, "kd": np.full(ROBOTS, 0.3)}
    if law == "pd":
        return whole
    axes = 3 if law == "end_effector" else 6
    return whole | {
        "damping": np.multiply.outer(200 * spread, np.ones(axes)),
        "stiffness": np.full((ROBOTS, axes), 3e3),
    }


def tangents_of(simulation, gains):
    """Return tangents of the metrics by each number of the gains, in an array like the gains with a last axis more."""
    places = [(name, place) for name, value in gains.items() for place in np.ndindex(*value.shape[1:])]
    along = {name: np.zeros((len(places), *value.shape)) for name, value in gains.items()}
    for direction, (name, place) in enumerate(places):
        along[name][(direction, slice(None), *place)] = 1
    values, tangents = simulation.jvp(gains, along, dtype=np.float64)
    found = {}
    for metric, each in tangents.items():
        found[metric] = {name: np.zeros(value.shape) for name, value in gains.items()}
        for direction, (name, place) in enumerate(places):
            found[metric][name][(slice(None), *place)] = each[direction]
    return values, found


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_the_tangents(case, name):
    """Of every metric that is a real number, by all gains, in float64 to 1e-8 of the largest."""
    law = name.split(" ")[0]
    simulation = mc.Simulation(case("case_1_2", law, (SHORT | WALKS[name]).items()))
    gains = gains_of(law)
    _, tangents = tangents_of(simulation, gains)
    weights = {name: np.zeros((len(tangents), ROBOTS)) for name in tangents}
    for row, metric in enumerate(tangents):
        weights[metric][row] = 1
    found = simulation.vjp(gains, weights, dtype=np.float64)
    some = 0
    for row, (metric, expected) in enumerate(tangents.items()):
        largest = max(np.abs(np.nan_to_num(expected[name] * gains[name])).max() for name in gains)
        some += largest > 0
        for name in gains:
            error = np.nan_to_num(found[name][row] - expected[name]) * gains[name]
            assert np.abs(error).max() <= 1e-8 * largest, (metric, name)
    assert some > 5
