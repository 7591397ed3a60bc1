"""How often the verdict of a comparison claims what is not there, and finds what is: made-up walks of known laws.

`python -m tests.tuning.comparisons.test_verdicts 2000 docs/studies/false_claims.csv` makes 2,000 comparisons of each
kind and writes the shares; with a third argument, "claim" or "found", those of questions with this word.
"""

import concurrent.futures
import csv
import functools
import multiprocessing
import os
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
PROCESSES = os.process_cpu_count() if hasattr(os, "process_cpu_count") else os.cpu_count()
METRICS = ["force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque", "travel"]


class Study(NamedTuple):
    """How comparisons are made up."""

    walks: int = 512
    seeds: int = 3
    luck: float = 0.015  # standard deviation among the seeds of a law's search, relative, of all metrics together
    each: float = 0.01  # of each metric for itself
    modes: float = 0.0  # distance of two places where a search may end, relative, of each metric for itself
    better: float = 0.0  # by how much the first law betters every metric
    unlucky: int = 1  # by how many times the last law's luck is that of the others
    spikes: float = 0.0  # share of walks in which a law's metrics are 20 times as large, with its mean that of pd
    worst: bool = False  # whether differences among the worst walks count too


def walks(rng, study):
    """Walks in which all gains are alike, but for the first law, which is better by a part of every metric.

    Hard draws are hard for all gains; metrics have a common part, and long tails; 2 % of the walks fail by chance. What
    a search finds depends on its seed; better hardware has the results of the searches of pd, pd itself has none.
    """
    shape = (len(NAMES), study.seeds, study.walks)
    hard, own = rng.normal(size=study.walks), rng.normal(size=shape)
    common = study.luck * rng.normal(size=(*shape[:2], 1))
    spiked = rng.uniform(size=(len(LAWS), 1, study.walks)) < study.spikes
    data = {}
    for name in METRICS:
        larger = name == "travel"
        luck = common + study.each * rng.normal(size=(*shape[:2], 1))
        luck += study.modes * rng.integers(0, 2, (*shape[:2], 1))
        luck[len(LAWS) - 1] *= study.unlucky
        luck[NAMES.index(HARDWARE)], luck[-1] = luck[len(LAWS)], 0.0
        noise = 0.15 * own + 0.1 * rng.normal(size=shape)
        noise[-1] = noise[-1, :1]
        values = np.exp(0.4 * hard + noise + luck)
        values[: len(LAWS)] *= np.where(spiked, 20.0, 1.0) / (1 + 19 * study.spikes)
        values[0] *= 1 + study.better if larger else 1 - study.better
        data[name] = (paired.DIMS, values, {"larger_is_better": int(larger), "units": "N"})
    data["peak_pull_force"][1][...] = np.where(rng.uniform(size=shape) < 0.02, 1e3, data["peak_pull_force"][1])
    data["peak_utilization"] = (paired.DIMS, data["peak_pull_force"][1] / 100)
    data["diverged"] = (paired.DIMS, np.zeros(shape, bool))
    coordinates = {"gains": NAMES, "seed": np.arange(study.seeds), "member": np.arange(study.walks)}
    return xr.Dataset(data, coordinates)


def table_of(data, resamples=400):
    means = data.sel(gains="pd").mean(["seed", "member"])
    terms = tuple(
        Term(name, float(means[name]), 1.0, float(means[name]), name == "travel")
        for name in METRICS
        if name != "peak_pull_force"
    )
    goal = Objective(terms, (), worst=Worst())
    return paired.compared(data, METRICS, "retuned_pd", goal, shared=[HARDWARE], count=resamples)


def false_claim(study, seed):
    """Tell whether anything is claimed of laws that are alike: a difference in the table, or a word of the verdict."""
    table = table_of(walks(np.random.default_rng((1, seed)), study))
    statistics = ["mean", "worst"] if study.worst else ["mean"]
    said = paired.verdict(table, LAWS, "", [HARDWARE])
    real = table["real"].sel(gains=[*LAWS, HARDWARE], statistic=statistics).any()
    return bool(real) or said.best is not None or "would better pd" in said.in_words


def processes():
    """Return a pool of new processes: JAX, which other tests have started, must not be forked."""
    return concurrent.futures.ProcessPoolExecutor(PROCESSES, multiprocessing.get_context("spawn"))


def false_claims(count, study):
    """Return in how many comparisons of laws that are alike anything is claimed."""
    with processes() as pool:
        return sum(pool.map(functools.partial(false_claim, study), range(count), chunksize=10))


def best_of(study, seed):
    """Return the law that a comparison calls better than pd, None where none."""
    table = table_of(walks(np.random.default_rng((2, seed)), study))
    return paired.verdict(table, LAWS, "", [HARDWARE]).best


def found(count, study):
    """Return in how many comparisons the law that is better is called so, and in how many another one is."""
    with processes() as pool:
        best = list(pool.map(functools.partial(best_of, study), range(count), chunksize=10))
    return best.count(LAWS[0]), sum(name in LAWS[1:] for name in best)


FEW = Study(walks=128)  # the members of a comparison by default
# each search has walks of its own: the luck of their draw is a part of its luck
NULL = {
    "luck of 1.5 %": FEW,
    "one erratic law": FEW._replace(unlucky=4),
    "much luck": FEW._replace(luck=0.1, each=0.05),
    "eight seeds, much luck": FEW._replace(seeds=8, luck=0.1, each=0.05),
    "luck of 3 %": FEW._replace(luck=0.03),
    "luck of the draw of 2 % besides": FEW._replace(luck=0.025),
    "luck in two modes": FEW._replace(luck=0.0, each=0.0, modes=0.1),
    "one search": FEW._replace(seeds=1, luck=0.03),
    "two seeds, luck in two modes": FEW._replace(seeds=2, luck=0.0, each=0.0, modes=0.1),
    "two seeds, one erratic law": FEW._replace(seeds=2, unlucky=4),
    "16 walks": FEW._replace(walks=16),
    "64 walks": FEW._replace(walks=64),
    "worst 5 % of 200 walks": FEW._replace(walks=200, worst=True),
    "spikes in 1 % of the walks": FEW._replace(spikes=0.01),
}
POWER = {
    f"{seeds} seeds, 128 walks, luck of 3 %": FEW._replace(seeds=seeds, luck=0.03, each=0.0, better=0.1)
    for seeds in (3, 4, 5, 6, 8)
}
POWER["3 seeds, 512 walks, luck of 3 %"] = Study(luck=0.03, each=0.0, better=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["luck of 1.5 %", "luck in two modes", "spikes in 1 % of the walks"])
def test_equal_laws_are_seldom_told_apart(name):
    """As many false claims as a chance of 5 % gives in 99 % of such tests, at the most."""
    count = 20
    assert sum(false_claim(NULL[name], seed) for seed in range(count)) <= scipy.stats.binom.ppf(0.99, count, 0.05)


@pytest.mark.nightly
@pytest.mark.parametrize("name", NULL)
def test_equal_laws_are_told_apart_in_one_comparison_of_twenty_at_most(name):
    count = 100
    assert false_claims(count, NULL[name]) <= scipy.stats.binom.ppf(0.99, count, 0.05)


@pytest.mark.nightly
def test_a_law_that_is_a_tenth_better_is_found():
    count = 40
    better, other = found(count, POWER["8 seeds, 128 walks, luck of 3 %"])
    assert better >= 0.9 * count and not other


def main(count, file, word=""):
    """Write how often equal laws are told apart and a better one is found, with exact 95 % intervals."""
    with open(file, "w", newline="") as written:
        table = csv.writer(written, lineterminator="\n")
        table.writerow(["question", "comparisons_of", "of", "hits", "percent", "low", "high"])
        rows = [("any false claim", name, false_claims, study) for name, study in NULL.items()]
        rows += [("10 % better law found", name, lambda *how: found(*how)[0], own) for name, own in POWER.items()]
        for question, name, counted, study in (row for row in rows if word in row[0]):
            hits = counted(count, study)
            ends = scipy.stats.binomtest(hits, count).proportion_ci()
            percents = [f"{100 * share:.1f}" for share in (hits / count, *ends)]
            table.writerow([question, name, count, hits, *percents])
            print(question, name, hits, count, *percents, flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), *sys.argv[2:])
