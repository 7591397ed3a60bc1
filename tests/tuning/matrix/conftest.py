"""The rows of the matrix: a scenario with one part of a reader's own, and how that part is named, drawn and made worse.

Walks are short and robots few: a cell costs a compilation, and little more.
"""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.execution.batch_axes import own_axes
from tuning.problem.ensemble import Ensemble

FILE = str(Path(__file__).with_name("own_parts.py"))
GAINS = {"mine": mc.Gains(1.0, 300.0, 3000.0)}
MEMBERS = 2
METRICS = ("peak_foot_force", "peak_utilization", "force_variation", "base_deviation")


class Part(NamedTuple):
    """One part of a reader's own in a scenario."""

    changes: dict[str, Any]  # of the config
    path: str  # of one of its values
    span: tuple[float, float]  # of that value


PARTS = {
    "contact": Part({"contact.kind": f"{FILE}:Sticky"}, "contact.spread", (0.1, 0.8)),
    "drive": Part({"hardware.servo.kind": f"{FILE}:Belts"}, "hardware.servo.tension", (30.0, 60.0)),
    "disturbance": Part(
        {"disturbance.others": [{"kind": f"{FILE}:Gust"}]}, "disturbance.others.0.strength", (0.5, 2.0)
    ),
    # holds have no numbers at paths: their contact has
    "holds": Part(
        {
            "gait.footholds": "nearest",
            "ground.holds.wall": {"pitch": 0.03},
            "ground.holds.limit": 3.0,
            "time_step": 5e-4,
        },
        "contact.stiffness",
        (6e3, 1e4),
    ),
    "sensor": Part(
        {"hardware.force_sensor": {"bias": 0.3, "delay": 0.002, "filter": 80.0}},
        "hardware.force_sensor.bias",
        (0.1, 0.5),
    ),
}


def slow(*quicker):
    """Every row, slow: some in each run of the slow tests, the others at night."""
    marks = {row: pytest.mark.slow if row in quicker else pytest.mark.nightly for row in PARTS}
    rows = [pytest.param(row, marks=mark) for row, mark in marks.items()]
    return pytest.mark.parametrize("name", rows, indirect=True, scope="session")


@pytest.fixture(scope="session", params=PARTS)
def name(request):
    return request.param


@pytest.fixture(scope="session")
def part(name):
    return PARTS[name]


@pytest.fixture(scope="session")
def scenario(part):
    short = {"duration": 0.1, "disturbance.cargo.mass": 0.0}
    return mc.load_scenario("case_1_2").with_overrides({**short, **part.changes})


@pytest.fixture(scope="session")
def ensemble(part):
    """Draws the value of the part, and masses."""
    others = dict.fromkeys(("pushes", "cargo", "gravity"))
    return Ensemble.make({"members": MEMBERS, **others, "draw": {part.path: {"range": part.span}}})


def member(parameters, number):
    """The parameters of one member of a draw, whose values have axes (members, 1)."""
    return jax.tree.map(
        lambda value, own: np.asarray(value)[number, 0] if np.ndim(value) > own else value,
        parameters,
        own_axes(parameters),
    )


def alone(scenario, gains, parameters=None, law=None, *, smooth=True):
    """The metrics of a rollout in which, as in searches, nothing is torn off."""
    return mc.metrics(mc.Simulation(scenario, law, smooth=smooth).rollout(gains, parameters))


def check(found, expected):
    """Metrics in single precision are those of a rollout in double precision."""
    for name in METRICS:
        np.testing.assert_allclose(found[name], expected[name], rtol=5e-3, atol=1e-6, err_msg=name)
