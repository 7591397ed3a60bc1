"""How often the verdict of a comparison claims what is not there, and finds what is: made-up walks of known laws."""

import numpy as np
import pytest
import scipy.stats
import xarray as xr

from tuning.comparisons import paired
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term

LAWS = ["base_admittance", "end_effector_admittance", "load_transfer", "internal_force"]
NAMES = [*LAWS, "retuned_pd", "half the friction", "pd"]
METRICS = ["force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque", "travel"]
WALKS = 512


def walks(rng, better=0.0):
    """Walks in which all gains are alike, but for the first law, which is better by a part of every metric.

    Hard draws are hard for all gains; metrics have a common part, and long tails; 2 % of the walks fail by chance.
    """
    shape = (len(NAMES), WALKS)
    hard, own = rng.normal(size=WALKS), rng.normal(size=shape)
    data = {}
    for name in METRICS:
        larger = name == "travel"
        exponent = 0.4 * hard + 0.15 * own + 0.1 * rng.normal(size=shape)
        values = np.exp(exponent)
        values[0] *= 1 + better if larger else 1 - better
        data[name] = (("gains", "member"), values, {"larger_is_better": int(larger), "units": "N"})
    data["peak_pull_force"][1][...] = np.where(rng.uniform(size=shape) < 0.02, 1e3, data["peak_pull_force"][1])
    data["diverged"] = (("gains", "member"), np.zeros(shape, bool))
    return xr.Dataset(data, {"gains": NAMES, "member": np.arange(WALKS)}, {"holding_limit": 100.0})


def verdict(data, resamples=1000):
    means = data.sel(gains="pd").mean("member")
    terms = tuple(
        Term(name, float(means[name]), 1.0, float(means[name]), name == "travel")
        for name in METRICS
        if name != "peak_pull_force"
    )
    goal = Objective(terms, (), worst=Worst())
    table = paired.compared(data, METRICS, "retuned_pd", goal, count=resamples)
    return paired.verdict(table, LAWS, LAWS, ["half the friction"])


def claims(said):
    """Tell whether a verdict says that anything is better, or worth anything."""
    words = said.in_words
    return any(part in words for part in ("is better than", "sensor is worth", "would better pd"))


@pytest.mark.nightly
def test_equal_laws_are_told_apart_in_one_comparison_of_twenty_at_most():
    """As many false claims as a chance of 5 % gives in 99 % of such tests, at the most."""
    count = 200
    false = sum(claims(verdict(walks(np.random.default_rng((1, seed))))) for seed in range(count))
    assert false <= scipy.stats.binom.ppf(0.99, count, 0.05)


@pytest.mark.nightly
def test_a_law_that_is_a_tenth_better_is_found():
    count = 40
    found = [verdict(walks(np.random.default_rng((2, seed)), better=0.1)) for seed in range(count)]
    assert sum(said.best == LAWS[0] for said in found) >= 0.9 * count
    assert not any(said.best in LAWS[1:] for said in found)
