"""How often the verdict of a comparison claims what is not there, and finds what is: made-up walks of known laws.

`python -m tests.tuning.comparisons.test_verdicts 300` makes 300 comparisons of each kind and prints the shares.
"""

import sys
from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats
import xarray as xr

from tuning.comparisons import paired
from tuning.problem.ensemble import Worst
from tuning.problem.objectives import Objective, Term

LAWS = ["base_admittance", "end_effector_admittance", "load_transfer", "internal_force"]
HARDWARE = "half the friction"
NAMES = [*LAWS, "retuned_pd", HARDWARE, "pd"]
METRICS = ["force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque", "travel"]


class Study(NamedTuple):
    """How comparisons are made up."""

    walks: int = 512
    seeds: int = 3
    luck: float = 0.015  # standard deviation among the seeds of a law's search, relative, of all metrics together
    each: float = 0.01  # of each metric for itself
    better: float = 0.0  # by how much the first law betters every metric
    unlucky: int = 1  # by how many times the last law's luck is that of the others


def walks(rng, study):
    """Walks in which all gains are alike, but for the first law, which is better by a part of every metric.

    Hard draws are hard for all gains; metrics have a common part, and long tails; 2 % of the walks fail by chance. What
    a search finds depends on its seed; better hardware has the results of the searches of pd, pd itself has none.
    """
    shape = (len(NAMES), study.seeds, study.walks)
    hard, own = rng.normal(size=study.walks), rng.normal(size=shape)
    common = study.luck * rng.normal(size=(*shape[:2], 1))
    data = {}
    for name in METRICS:
        larger = name == "travel"
        luck = common + study.each * rng.normal(size=(*shape[:2], 1))
        luck[len(LAWS) - 1] *= study.unlucky
        luck[NAMES.index(HARDWARE)], luck[-1] = luck[len(LAWS)], 0.0
        noise = 0.15 * own + 0.1 * rng.normal(size=shape)
        noise[-1] = noise[-1, :1]
        values = np.exp(0.4 * hard + noise + luck)
        values[0] *= 1 + study.better if larger else 1 - study.better
        data[name] = (paired.DIMS, values, {"larger_is_better": int(larger), "units": "N"})
    data["peak_pull_force"][1][...] = np.where(rng.uniform(size=shape) < 0.02, 1e3, data["peak_pull_force"][1])
    data["peak_utilization"] = (paired.DIMS, data["peak_pull_force"][1] / 100)
    data["diverged"] = (paired.DIMS, np.zeros(shape, bool))
    coordinates = {"gains": NAMES, "seed": np.arange(study.seeds), "member": np.arange(study.walks)}
    return xr.Dataset(data, coordinates)


def verdict(data, resamples=1000):
    means = data.sel(gains="pd").mean(["seed", "member"])
    terms = tuple(
        Term(name, float(means[name]), 1.0, float(means[name]), name == "travel")
        for name in METRICS
        if name != "peak_pull_force"
    )
    goal = Objective(terms, (), worst=Worst())
    table = paired.compared(data, METRICS, "retuned_pd", goal, shared=[HARDWARE], count=resamples)
    return paired.verdict(table, LAWS, "", [HARDWARE])


def claims(said):
    """Tell whether a verdict says that anything is better, or worth anything."""
    words = said.in_words
    return any(part in words for part in ("is better than", "sensor is worth", "would better pd"))


def false_claims(count, study):
    """Return in how many comparisons of laws that are alike anything is claimed."""
    return sum(claims(verdict(walks(np.random.default_rng((1, seed)), study))) for seed in range(count))


def found(count, study):
    """Return in how many comparisons the law that is better is called so, and in how many another one is."""
    best = [verdict(walks(np.random.default_rng((2, seed)), study)).best for seed in range(count)]
    return best.count(LAWS[0]), sum(name in LAWS[1:] for name in best)


FEW = Study(walks=128)  # the members of a comparison by default
NULL = {
    "one seed, no luck": FEW._replace(seeds=1, luck=0.0, each=0.0),
    "three seeds": FEW,
    "three seeds, one erratic law": FEW._replace(unlucky=4),
    "three seeds, much luck": FEW._replace(luck=0.1, each=0.05),
    "eight seeds, much luck": FEW._replace(seeds=8, luck=0.1, each=0.05),
}
POWER = {
    "three seeds": Study(better=0.1),
    "eight seeds, twice the luck": Study(seeds=8, luck=0.03, each=0.02, better=0.1),
}


@pytest.mark.nightly
@pytest.mark.parametrize("name", NULL)
def test_equal_laws_are_told_apart_in_one_comparison_of_twenty_at_most(name):
    """As many false claims as a chance of 5 % gives in 99 % of such tests, at the most."""
    count = 100
    assert false_claims(count, NULL[name]) <= scipy.stats.binom.ppf(0.99, count, 0.05)


@pytest.mark.nightly
@pytest.mark.parametrize("name", POWER)
def test_a_law_that_is_a_tenth_better_is_found(name):
    count = 40
    better, other = found(count, POWER[name])
    assert better >= 0.9 * count and not other


def main(count):
    """Print how often equal laws are told apart and a better one is found, with exact 95 % intervals."""

    def line(kind, name, hits):
        low, high = scipy.stats.binomtest(hits, count).proportion_ci()
        print(f"{kind}, {name}: {hits} of {count}, {hits / count:.1%} ({low:.1%} to {high:.1%})", flush=True)

    for name, study in NULL.items():
        line("any false claim", name, false_claims(count, study))
    for name, study in POWER.items():
        line("10 % better law found", name, found(count, study)[0])


if __name__ == "__main__":
    main(int(sys.argv[1]))
