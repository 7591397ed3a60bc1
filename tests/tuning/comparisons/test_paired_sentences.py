"""The sentences on laws and on the worth of a sensor, whole, from tables of differences that were written by hand."""

import numpy as np
import pytest
import xarray as xr

from tuning.comparisons import paired

INF = np.inf
BASE = "pd with its own kp and kd searched (retuned_pd, kp 17)"
METRICS = ["objective", "force_variation", "travel", "failed"]
# of each: value, ends of the interval of the difference, walks and seeds that would tell it from 0
MADE = {
    "mine": {"objective": (0.6, -0.3, -0.1), "force_variation": (44, 2, 6), "travel": (1.8, -0.3, -0.1)},
    "other": {"objective": (0.7, -0.16, -0.04), "force_variation": (40, -3, 3), "travel": (2.3, 0.1, 0.5)},
    "retuned_pd": {"objective": (0.8, 0, 0), "force_variation": (40, 0, 0), "travel": (2, 0, 0)},
    "half the delay": {"objective": (0.64, -0.24, -0.08)},
    "twice the rate": {"objective": (0.76, -0.072, -0.012)},
    "pd": {"objective": (1, 0.1, 0.3), "force_variation": (50, 8, 12)},
}


def table(changes=None, members=240, seeds=3, lacks="", baseline="retuned_pd"):
    """A table as `paired.compared` makes it, with some cells changed."""
    rows = {name: {**own, **(changes or {}).get(name, {})} for name, own in MADE.items()}
    fields = {name: np.full((len(METRICS), 2, len(rows)), np.nan) for name in paired.Interval._fields}
    for g, own in enumerate(rows.values()):
        for m, metric in enumerate(METRICS):
            value, low, high, *needed = own.get(metric, (0, 0, 0) if metric == "failed" else (2, 0, 0))
            base = rows[baseline].get(metric, (0 if metric == "failed" else 2,))[0]
            cell = value, value - base, low, high, *(*needed, INF, INF)[:2]
            for name, each in zip(fields, cell, strict=True):
                fields[name][m, 0, g] = each
    dims = ("metric", "statistic", "gains")
    data = xr.Dataset(
        {name: (dims, each) for name, each in fields.items()},
        {"metric": METRICS, "statistic": ["mean", "worst"], "gains": [*rows]},
    )
    data["real"] = (data["low"] > 0) | (data["high"] < 0)
    data["larger_is_better"] = ("metric", np.array([False, False, True, False]))
    return data.assign_attrs(baseline=baseline, lacks=lacks, members_compared=members, seeds=seeds)


OPEN = {"mine": {"objective": (0.78, -0.06, 0.02, 811.2, INF)}, "other": {"objective": (0.85, -0.05, 0.15, 90.0, 2.0)}}
WORSE = {"mine": {"objective": (0.9, 0.02, 0.18)}, "other": {"objective": (1.0, 0.1, 0.3)}}
BETTER = "mine is better than " + BASE + ", by 25.0% (12.5 to 37.5%) of the objective, 0.6 beside 0.8"
BUT = BETTER + ", though worse in force variation, travel"
CANNOT = "mine, other cannot be told apart from " + BASE + " in the objective with 240 walks and 3 seeds: "
NO_HARDWARE = "; the scenario has no delay, friction or rate to better"
SHOW_NONE = f"show no worth of a force sensor: mine beside {BASE}, the best law that reads no forces"


@pytest.mark.parametrize(("how", "asked", "best", "said"), [
    ({}, {}, "mine", BUT + NO_HARDWARE),
    ({"changes": {"other": {"objective": (0.5, -0.4, -0.2)}}}, {}, "other",
     f"other is better than {BASE}, by 37.5% (25.0 to 50.0%) of the objective, 0.5 beside 0.8{NO_HARDWARE}"),
    ({"changes": {"mine": {"force_variation": (40, -2, 2), "travel": (2.3, 0.1, 0.5)}}}, {"sensor": "a sensor"},
     "mine", f"{BETTER}; a sensor{NO_HARDWARE}"),
    # a law that loses walks is none that is better; a share of 5 % at the end of its interval is allowed
    ({"changes": {"mine": {"failed": (0.04, -0.01, 0.06)}}}, {}, "other",
     f"other is better than {BASE}, by 12.5% (5.0 to 20.0%) of the objective, 0.7 beside 0.8; "
     f"lost walks: mine 4.0%, other 0.0%, retuned_pd 0.0%{NO_HARDWARE}"),
    ({"changes": {"mine": {"failed": (0.004, -0.01, 0.05)}}}, {}, "mine",
     f"{BUT}; lost walks: mine 0.4%, other 0.0%, retuned_pd 0.0%{NO_HARDWARE}"),
    ({"changes": {"mine": {"failed": (0.0, -0.06, 0.06)}}}, {}, "mine", f"{BUT}{NO_HARDWARE}"),
    ({"changes": {"retuned_pd": {"failed": (0.1, 0, 0)}}}, {}, "mine",
     f"{BUT}; lost walks: mine 0.0%, other 0.0%, retuned_pd 10.0%{NO_HARDWARE}"),
    # nobody better
    ({"changes": OPEN}, {}, None,
     f"{CANNOT}0.78, 0.85 beside 0.8 (812 walks would, if the difference is what it seems){NO_HARDWARE}"),
    ({"changes": {**OPEN, "mine": {"objective": (0.78, -0.06, 0.02, INF, 11.5)}}}, {}, None,
     f"{CANNOT}0.78, 0.85 beside 0.8 (12 seeds would, if the difference is what it seems){NO_HARDWARE}"),
    ({"changes": {**OPEN, "mine": {"objective": (0.78, -0.06, 0.02)}}, "seeds": 1}, {}, None,
     "mine, other cannot be told apart from " + BASE + " in the objective with 240 walks: 0.78, 0.85 beside 0.8 "
     f"(more of both would, if the difference is what it seems){NO_HARDWARE}"),
    ({"changes": {**OPEN, "mine": {"objective": (0.81, -0.06, 0.08, 20, 3)}}}, {}, None,
     f"{CANNOT}0.81, 0.85 beside 0.8{NO_HARDWARE}"),
    ({"changes": {**OPEN, "mine": {"objective": (0.8, -0.06, 0.06, 20, 3)}}}, {}, None,
     f"{CANNOT}0.8, 0.85 beside 0.8{NO_HARDWARE}"),
    ({"changes": {**WORSE, "other": OPEN["other"]}}, {}, None,
     f"other cannot be told apart from {BASE} in the objective with 240 walks and 3 seeds: 0.85 beside 0.8"
     f"{NO_HARDWARE}"),
    ({"changes": WORSE}, {}, None,
     f"none is better than {BASE}: the nearest, mine, has 12.5% more objective, 0.9 beside 0.8{NO_HARDWARE}"),
    # one that seems better and loses walks is not open
    ({"changes": {"mine": {"failed": (0.2, 0.1, 0.3)}, "other": {"failed": (0.3, 0.2, 0.4)}}}, {}, None,
     f"none is better than {BASE}: the nearest, mine, has 25.0% less objective, 0.6 beside 0.8; lost walks: "
     f"mine 20.0%, other 30.0%, retuned_pd 0.0%{NO_HARDWARE}"),
    # nothing to tell
    ({}, {"outside": ["retuned_pd"]}, None,
     f"no verdict: a search of {BASE} found no gains that keep its limits"),
    ({}, {"outside": ["mine", "other"]}, None,
     f"none is better than {BASE}: of no law all searches found gains that keep the limits"),
    ({}, {"outside": ["mine"]}, "other",
     f"other is better than {BASE}, by 12.5% (5.0 to 20.0%) of the objective, 0.7 beside 0.8{NO_HARDWARE}"),
    ({"lacks": "too few walks"}, {}, None, "no verdict: too few walks"),
    ({"lacks": "too few walks", "changes": {"mine": {"failed": (0.125, 0, 0)}}}, {}, None,
     "no verdict: too few walks; lost walks: mine 12.5%, other 0.0%, retuned_pd 0.0%"),
    ({}, {"unsettled": ["mine", "other"]}, "mine",
     f"{BUT}{NO_HARDWARE}; not every search of mine, other had converged"),
    # better hardware, beside the best of the laws
    ({}, {"hardware": ["half the delay", "twice the rate"]}, "mine",
     f"{BUT}; half the delay would better pd by 20.0% (10.0 to 30.0%) of its objective"),
    ({"changes": {"half the delay": {"objective": (0.3, -0.6, -0.32)}}}, {"hardware": ["half the delay"]}, "mine",
     f"{BUT}; half the delay would better pd by 62.5% (40.0 to 75.0%) of its objective, more than by any of these "
     "laws"),
    ({}, {"hardware": ["twice the rate"]}, "mine",
     f"{BUT}; twice the rate would better pd by 5.0% (1.5 to 9.0%) of its objective, less than by the best of these "
     "laws"),
    ({"changes": WORSE}, {"hardware": ["half the delay", "twice the rate"]}, None,
     f"none is better than {BASE}: the nearest, mine, has 12.5% more objective, 0.9 beside 0.8; "
     "half the delay would better pd by 20.0% (10.0 to 30.0%) of its objective"),
    ({"changes": {"half the delay": {"objective": (0.79, -0.05, 0.03)},
                  "twice the rate": {"objective": (0.9, 0.05, 0.2)}}},
     {"hardware": ["half the delay", "twice the rate"], "sensor": "a sensor"}, "mine",
     f"{BUT}; a sensor; 240 walks and 3 seeds show no gain for pd by half the delay, twice the rate"),
])  # fmt: skip
def test_the_verdict_on_laws(how, asked, best, said):
    given = {"laws": ["mine", "other"], "sensor": "", "hardware": [], "joint": {"kp": 17.0}} | asked
    assert paired.verdict(table(**how), **given) == (best, said)


@pytest.mark.parametrize(("how", "asked", "said"), [
    # of a lead over pd (1) the sensor is worth 0.2, 0.1 to 0.3
    ({}, {}, f"of the lead over pd a force sensor is worth 20.0% (10.0 to 30.0%): mine beside {BASE}, the best law "
             "that reads no forces, 0.6 beside 0.8, though it is worse in force variation, travel"),
    ({}, {"name": "other", "whole": 2.0, "what": "reading joint efforts"},
     f"of the lead over pd reading joint efforts is worth 5.0% (2.0 to 8.0%): other beside {BASE}, the best law that "
     "reads no forces, 0.7 beside 0.8"),
    ({"changes": {"mine": {"force_variation": (30, -14, -6)}}}, {"metric": "force_variation", "whole": 50.0},
     f"of the lead over pd a force sensor is worth 20.0% (12.0 to 28.0%): mine beside {BASE}, the best law that reads "
     "no forces, 30 beside 40, though it is worse in travel"),
    ({}, {"name": "other", "metric": "travel", "whole": 2.0},
     f"of the lead over pd a force sensor is worth 15.0% (5.0 to 25.0%): other beside {BASE}, the best law that reads "
     "no forces, 2.3 beside 2"),
    ({"changes": OPEN}, {}, f"240 walks and 3 seeds {SHOW_NONE}: 0.78 beside 0.8"),
    ({"changes": {"mine": {"failed": (0.1, 0.05, 0.15)}}, "seeds": 1}, {},
     f"240 walks {SHOW_NONE}: 0.6 beside 0.8"),
    ({"changes": WORSE}, {}, f"240 walks and 3 seeds {SHOW_NONE}: 0.9 beside 0.8"),
    ({"changes": {"retuned_pd": {"objective": (0.0, 0, 0)}}}, {},
     f"240 walks and 3 seeds {SHOW_NONE}: 0.6 beside 0"),
])  # fmt: skip
def test_the_worth_of_a_sensor(how, asked, said):
    given = {"name": "mine", "whole": 1.0, "joint": {"kp": 17.0}} | asked
    assert paired.sensor_in_words(table(**how), **given) == said


@pytest.mark.parametrize(("changes", "standing"), [
    ({"force_variation": (30, -14, -6)}, 1),
    ({"force_variation": (44, 2, 6)}, -1),
    ({"force_variation": (39, -4, 2)}, 0),
    # lost walks: more of them, perhaps more of them, fewer, and fewer with a worse mean
    ({"force_variation": (40, -3, 3), "failed": (0.1, 0.05, 0.15)}, -1),
    ({"force_variation": (30, -14, -6), "failed": (0.1, 0.05, 0.15)}, 0),
    ({"force_variation": (30, -14, -6), "failed": (0.04, -0.01, 0.06)}, 0),
    ({"force_variation": (40, -3, 3), "failed": (-0.1, -0.15, -0.05)}, 1),
    ({"force_variation": (44, 2, 6), "failed": (-0.1, -0.15, -0.05)}, 0),
    ({"force_variation": (44, 2, 6), "failed": (0.1, 0.05, 0.15)}, -1),
])  # fmt: skip
def test_gains_are_ahead_or_behind_in_a_mean_and_in_lost_walks(changes, standing):
    assert paired.standing(table({"mine": changes}), "mine", "force_variation") == standing


def test_differences_are_rows_of_those_that_are_known():
    own = table()
    rows = paired.differences(own)
    assert {row["statistic"] for row in rows} == {"mean"} and "retuned_pd" not in {row["gains"] for row in rows}
    assert len(rows) == len(METRICS) * (len(MADE) - 1)
    found = {(row["metric"], row["gains"]): row for row in rows}
    assert found["objective", "mine"] == {
        "gains": "mine", "baseline": "retuned_pd", "metric": "objective", "statistic": "mean",
        "difference": pytest.approx(-0.2), "low": -0.3, "high": -0.1, "claimed": True,
    }  # fmt: skip
    assert not found["force_variation", "other"]["claimed"]
