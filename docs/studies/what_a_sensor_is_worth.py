"""What is a force sensor worth: the best law that reads forces beside the best that does not, searched alike.

    python docs/studies/what_a_sensor_is_worth.py results/worth --hardware mx_64 [--case 2] [--minutes 8] [--quick]
    python docs/studies/what_a_sensor_is_worth.py results/worth --table docs/studies/what_a_sensor_is_worth.csv

The first walks: for each case and each seed, laws and gait are searched by CMA-ES on training walks drawn with that
seed, within 2 % of the means of the pd that was searched on them, and walked on 512 walks that no search saw. A row for
each search goes into a file for each case and hardware; rows that are there are not searched again, so that a stopped
study goes on. The second puts all rows into one table and prints the page's.
"""

import argparse
import csv
import dataclasses
import json
import sys
import time
from pathlib import Path

import numpy as np
from scipy.stats import t as student

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "guides")]

import ceiling as study
import ceiling_laws as searched

import mjx_climb as mc
import tuning
from mjx_climb.control import shipped
from mjx_climb.inputs.gait_values import scenario_with_gait
from mjx_climb.scenario.load import load_hardware, with_hardware
from tuning.gains import gains_file
from tuning.problem import ensemble as ensembles
from tuning.problem import spaces
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.readings import readings
from tuning.problem.search import Search

HARDWARE = ("ideal", "dynamixel_x", "mx_64")
OFFSETS = "FootOffsets@outward,upward"
# by name in the table: the law, and what its robot has in place of force sensors
LAWS = {
    "pd": ("PD", {}),
    "PlannedTransfer": ("PlannedTransfer", {}),
    "LoadTransfer": ("LoadTransfer", {}),
    "FootOffsets": (OFFSETS, {}),
    "PlannedTransfer+FootOffsets": (f"PlannedTransfer+{OFFSETS}", {}),
    "LoadTransfer+FootOffsets": (f"LoadTransfer+{OFFSETS}", {}),
    "LoadTransfer by efforts": ("LoadTransfer", {"hardware.force_sensor.source": "joint_effort"}),
    "LoadTransfer along z, 50 ms late": (
        "LoadTransfer", {"hardware.force_sensor.axes": "z", "hardware.force_sensor.delay": 0.05},
    ),
}  # fmt: skip
ON_ALL_FEET = 0.78  # duty at which transfers begin: at 0.75 there is no time in which loads can be handed over
METRICS = ("objective", *searched.KEPT[:-2])  # of a row
LEVEL = 0.95


def walks_of(scenario, members, seed):
    """Return training walks of a seed as an ensemble."""
    return study.DRAWS[scenario].model_copy(update={"members": members, "seed": seed})


class Cell:
    """A case on a robot: the unseen walks, and the rows that there are."""

    def __init__(self, asked, hardware, case):
        """Read the rows that there are."""
        self.asked, self.hardware, self.case = asked, hardware, case
        ideal = mc.load_scenario(f"case_{case}").with_overrides({"duration": asked.seconds})
        self.scenario = with_hardware(ideal, load_hardware(hardware), hardware)  # with the noise of its sensors
        self.unseen = ensembles.fresh(walks_of(case, asked.unseen, 0))
        self.file = asked.out / f"{hardware}_{case}.json"
        self.rows = json.loads(self.file.read_text()) if self.file.exists() else []

    def found(self, law, seed):
        """Return the row of a search, None where there is none."""
        return next((row for row in self.rows if (row["law"], row["seed"]) == (law, seed)), None)

    def search(self, name, seed, until):
        """Search a law on the walks of a seed, which ends in time, and walk it on unseen ones."""
        asked, (law_name, sensors), began = self.asked, LAWS[name], time.time()
        draw = walks_of(self.case, asked.members, seed)
        goal, judges = searched.goals_on(self.scenario, study.WEIGHTS, draw, self.unseen)
        goal = dataclasses.replace(goal, limits=tuple(
            limit._replace(margin=searched.PULL_MARGIN) if limit.metric == "peak_utilization" else limit
            for limit in goal.limits
        ))  # fmt: skip
        law, begins, held = shipped(law_name), {}, searched.Within(goal, ())
        if name != "pd":
            pd = self.found("pd", seed)
            held = searched.Within(goal, searched.most_of(pd["search"]))
            part = self.found(name.partition("+")[0], seed) if "+" in name else None
            begins = (part or pd)["gains"]
            begins = begins | {"gait.duty": max(begins.get("gait.duty", 0.0), ON_ALL_FEET)}
        own = {gain: np.asarray(begins[gain], float) for gain in law.GAINS if gain in begins}
        law = dataclasses.replace(law, **own)
        joint = {f"control.{gain}": begins[gain] for gain in ("kp", "kd") if gain in begins}
        scenario = self.scenario.with_overrides(sensors | joint)
        scenario = scenario_with_gait(scenario, {k: v for k, v in begins.items() if k.startswith("gait.")})
        scenario = under_pd(scenario) if name == "pd" else scenario
        cycle = self.scenario.gait.cycle
        wanted = Search(
            space="isotropic", joint_gains=True, precision="float32", seed=seed,
            also=(*searched.ALSO, *(("pull_limit",) if "pull_limit" in law.GAINS else ())),
            bounds={"gait.cycle": (cycle / 2, min(2 * cycle, asked.seconds))},
        )  # fmt: skip
        rounds = []

        def told(now):
            rounds.append(now.best)
            if time.time() > until and len(rounds) > 1:
                raise KeyboardInterrupt  # ends the search with what it has

        each = ensembles.draw(scenario, draw)
        found = tuning.tune(
            scenario, wanted, law=law, objective=held, metrics=searched.TABLE, parameters=each, method="cmaes",
            starts=asked.points, iterations=asked.rounds, progress=told,
        )  # fmt: skip
        space = spaces.space(scenario, wanted, law)
        theta = space.from_gains(found.gains)[None]
        how = {"law": law, "metrics": searched.TABLE}
        of_search = Problem(scenario, space, objective=goal, parameters=each, members=asked.members, **how)
        fresh = Problem(
            scenario, space, objective=judges, parameters=ensembles.draw(scenario, self.unseen), members=asked.unseen,
            **how,
        )  # fmt: skip
        walked = searched.values(fresh, theta)
        gains = {gain: float(np.ravel(value)[0]) for gain, value in gains_file.by_name(found.gains).items()}
        self.rows.append({
            "law": name, "seed": seed, "reads": sorted(readings(of_search)), "rounds": len(rounds), "gains": gains,
            "feasible": bool(found.feasible), "search": searched.means(searched.values(of_search, theta)),
            "unseen": searched.means(walked) | {"lost": float(walked["lost"].sum())},
            "walks": walked["objective"].tolist(), "seconds": time.time() - began,
        })  # fmt: skip
        self.file.write_text(json.dumps(self.rows))
        values = self.rows[-1]["unseen"]
        print(f"{self.file.stem}, {name}, seed {seed}: {values['objective']:.4f}, lost {values['lost']:.0f}, "
              f"{len(rounds)} rounds, {self.rows[-1]['seconds']:.0f} s", flush=True)  # fmt: skip


def walk(asked):
    """Search all rows that are asked for: pd of all cells first, then a law and a seed at a time, in like shares."""
    cells = [Cell(asked, hardware, case) for hardware in asked.hardware for case in asked.case]
    works = [(cell, law, seed) for law in asked.laws for seed in range(asked.seeds) for cell in cells]
    works = [(cell, law, seed) for cell, law, seed in works if cell.found(law, seed) is None]
    end = time.time() + 60 * asked.minutes
    for place, (cell, law, seed) in enumerate(works):
        now = time.time()
        cell.search(law, seed, now + max(0.0, end - now) / (len(works) - place))


def interval(values):
    """Return the mean of the searches of a law and half its 95 % interval, by Student's t."""
    values = np.asarray(values, float)
    if len(values) < 2:
        return float(values.mean()), float("nan")
    half = student.ppf((1 + LEVEL) / 2, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean()), float(half)


def summed(rows):
    """Return a line of the table for each law of a cell: means over its searches, the objective with its interval."""
    lines = []
    for law in dict.fromkeys(row["law"] for row in rows):
        own = [row for row in rows if row["law"] == law]
        mean, half = interval([row["unseen"]["objective"] for row in own])
        line = {"law": law, "reads": " ".join(own[0]["reads"]).replace("base pose", "base_pose"), "seeds": len(own)}
        line |= {"objective": mean, "half_of_95": half}
        line |= {name: np.mean([row["unseen"][name] for row in own]) for name in METRICS[1:]}
        line |= {"lost": np.mean([row["unseen"]["lost"] for row in own]), "rounds": np.mean([r["rounds"] for r in own])}
        lines.append(line)
    return lines


def table(asked):
    """Write all rows as one table, and print what a page says of it."""
    lines = []
    for hardware in HARDWARE:
        for case in study.CASES:
            file = asked.out / f"{hardware}_{case}.json"
            if file.exists():
                lines += [{"servos": hardware, "case": case} | line for line in summed(json.loads(file.read_text()))]
    with asked.table.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in line.items()} for line in lines)
    print("\n".join(page_table(list(csv.DictReader(asked.table.open())))))


def page_table(rows):
    """Return the lines of the page's table, from rows of the CSV."""
    lines = ["| | pd | best without forces | best with | worth of the sensor, of pd |", "|---|---|---|---|---|"]
    for servos, case in dict.fromkeys((row["servos"], row["case"]) for row in rows):
        own = [row for row in rows if (row["servos"], row["case"]) == (servos, case)]
        groups = [[row for row in own if ("forces" in row["reads"]) == reads] for reads in (False, True)]
        pd = next(row for row in own if row["law"] == "pd")
        without, best = (min(each, key=lambda row: float(row["objective"]), default=pd) for each in groups)
        share = (float(without["objective"]) - float(best["objective"])) / float(pd["objective"])
        cells = [f"{row['law']} {float(row['objective']):.3f}; {float(row['lost']):.1f}" for row in (pd, without, best)]
        lines.append(f"| {servos}, {case.replace('_', '.')} | {' | '.join(cells)} | {100 * share:+.1f} % |")
    return lines


def main():
    """Walk, or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", type=Path, help="write this file from the rows that there are, and walk nothing")
    parser.add_argument("--hardware", nargs="+", default=list(HARDWARE))
    parser.add_argument("--case", nargs="+", default=list(study.CASES))
    parser.add_argument("--laws", nargs="+", default=list(LAWS)[:3], help=f"of {', '.join(LAWS)}; pd first")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=8.0, help="in which all searches end")
    parser.add_argument("--members", type=int, default=64, help="walks of a search")
    parser.add_argument("--points", type=int, default=96, help="of a round")
    parser.add_argument("--rounds", type=int, default=120, help="at most")
    parser.add_argument("--unseen", type=int, default=512)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--quick", action="store_true", help="one seed, few and short walks: does it run?")
    asked = parser.parse_args()
    if asked.table is not None:
        table(asked)
        return
    if asked.quick:
        asked.seeds, asked.members, asked.points, asked.rounds, asked.unseen, asked.seconds = 1, 2, 4, 2, 4, 8.0
    asked.out.mkdir(parents=True, exist_ok=True)
    walk(asked)


if __name__ == "__main__":
    main()
