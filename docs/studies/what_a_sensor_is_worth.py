"""What is a force sensor worth: the best law that reads forces beside the best that does not, searched alike.

    python docs/studies/what_a_sensor_is_worth.py results/worth [--hardware mx_64] [--case 2] [--minutes 8]
    python docs/studies/what_a_sensor_is_worth.py results/worth --table docs/studies/what_a_sensor_is_worth.csv

The first searches laws and gait by CMA-ES for each case and hardware, each in a process of its own: the searches of all
seeds walk side by side, each on walks drawn with its seed, within 2 % of the means of the pd that was searched on them.
They begin at the config's gains, at the best that are known and at pd's, and begin anew where they stall, from the best
or from another start; their best points walk once more on other walks of that seed, and the best of these on 512 walks
that no search saw. Each round is kept, so that a study that was stopped goes on. The second puts all results into one
table, the gains of each law into another, and prints the page's. `--varied` draws the hardware too, and `--own-gait`
searches no gait; with `--grips closing` grippers take 0.1 s to close. `--nominal` searches on the case's own walk, and
with `--worse` what was found walks on worse hardware too. `which_law.py`, `worse_hardware.py` and `robust_gains.py`
make tables of all metrics.
"""

import argparse
import csv
import functools
import itertools
import json
import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
from cmaes import CMA

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "guides")]

import ceiling as study
import ceiling_laws as searched
import figures

import mjx_climb as mc
from mjx_climb.control import shipped
from mjx_climb.execution import devices
from mjx_climb.inputs.gait_values import own_gait
from mjx_climb.scenario.load import load_hardware, with_hardware
from tuning.comparisons import degraded, paired
from tuning.gains import gains_file
from tuning.methods import cmaes
from tuning.problem import ensemble as ensembles
from tuning.problem import evaluation, spaces
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.readings import readings
from tuning.problem.search import Search
from tuning.problem.variations import Factor, changed, paths_of, scalable
from tuning.searches import ceiling as bounds
from tuning.searches.tune import start_of

HARDWARE = ("ideal", "dynamixel_x", "mx_64")
OFFSETS = "FootOffsets@outward,upward"
# by name in the table: the law, and what its robot has in place of force sensors
LAWS = {
    "pd": ("PD", {}),
    "FootOffsets": (OFFSETS, {}),
    "PlannedTransfer": ("PlannedTransfer", {}),
    "LoadTransfer": ("LoadTransfer", {}),
    "PlannedTransfer+FootOffsets": (f"PlannedTransfer+{OFFSETS}", {}),
    "LoadTransfer+FootOffsets": (f"LoadTransfer+{OFFSETS}", {}),
    "LoadTransfer by efforts": ("LoadTransfer", {"hardware.force_sensor.source": "joint_effort"}),
    "LoadTransfer along z, 50 ms late": (
        "LoadTransfer", {"hardware.force_sensor.axes": "z", "hardware.force_sensor.delay": 0.05},
    ),
    **{name: (name, {}) for name in ("VirtualModelAdmittance", "EndEffectorAdmittance", "InternalForce", "ClimbSDK")},
}  # fmt: skip
GRIPS = {"at once": {}, "closing": {"contact.closing_time": 0.1, "contact.capture_distance": 0.005}}  # s, m
ON_ALL_FEET = 0.78  # duty at which transfers begin: at 0.75 there is no time in which loads can be handed over
RAN_OFF = 1.0  # m, base deviation: a mean with a walk that ran off says nothing
METRICS = ("objective", *searched.KEPT[:-2])  # of a row
WORSE, WORSE_MEMBERS = "worse", 128
OF_WALKS = (*METRICS[1:], "peak_utilization", "diverged")  # kept of each unseen walk
# of a population, of one that begins anew, and of the first one about each start, relative to the width of the box
SPREAD, WIDE, NEAR = 0.12, 0.25, 0.06
FLAT, PATIENCE = 5e-4, 25  # a search begins anew that finds better by no more in so many rounds
AHEAD = 200  # points of each search that are kept, of which the best walk once more
JOINT = {"kp": (5.0, 200.0), "kd": (0.01, 3.0)}
# of the time; others 1
SHARES = {"pd": 0.3, "FootOffsets": 0.3, "PlannedTransfer+FootOffsets": 0.7, "LoadTransfer+FootOffsets": 0.7}
GAINS = ("ceiling_gains", "what_a_sensor_is_worth_gains")  # tables of the best that are known


def known(hardware, case, law):
    """Return the gains of a law, and of the one that it is made of, that are known: those of this hardware first."""
    names, found = {law, law.partition("+")[0]}, {}
    names |= {"LoadTransfer"} if "Transfer" in law else {"PD", "pd"}
    for file in (Path(__file__).with_name(f"{name}.csv") for name in GAINS):
        for row in csv.DictReader(file.open()) if file.exists() else ():
            if row["case"] == case and row["law"] in names:
                place = row["servos"] != hardware, file.stem, row["servos"], row["law"]
                each = map(float, row["value"].strip("[]").split(","))  # of all axes
                found.setdefault(place, {})[row["gain"]] = float(np.mean(list(each)))
    return [found[place] for place in sorted(found)]


class Walks:
    """A law on a robot, and the numbers that are searched."""

    def __init__(self, scenario, law, own_gait=False):
        """Take the space from the settings of the ceiling's laws."""
        cycle = scenario.gait.cycle
        longest = max(cycle, min(2 * cycle, scenario.duration))  # a walk has a whole one
        also = (*(() if own_gait else searched.ALSO), *(("pull_limit",) if "pull_limit" in law.GAINS else ()))
        bound = JOINT | ({} if own_gait else {"gait.cycle": (cycle / 2, longest)})
        wanted = Search(space="isotropic", joint_gains=True, also=also, bounds=bound)
        self.scenario, self.law, self.space = scenario, law, spaces.space(scenario, wanted, law)

    def gains(self, theta):
        """Return the gains of points (..., n) as arrays by name."""
        return gains_file.by_name(spaces.to_gains64(self.space, theta))

    def own(self, shape):
        """Return the config's own gains, of joint loop and gait too, which may lie outside of the space."""
        own = spaces.own_values(self.scenario, self.law) | own_gait(self.scenario)
        own |= {name: getattr(self.scenario.control, name) for name in ("kp", "kd")}
        own = {name: np.asarray(own[name], float) for name in self.space.index}
        return {name: np.broadcast_to(value, (*shape, *value.shape)) for name, value in own.items()}

    def metrics(self, gains, parameters):
        """Return metrics of gains (S, P) on parameters (M, S, 1): (M, S, P)."""
        how = {"law": self.law, "metrics": searched.TABLE, "dtype": np.float32, "unsteady": True}
        return mc.rollout_metrics(self.scenario, gains, parameters, **how)


def of_draws(scenario, draws):
    """Return the parameters of as many walks of each draw, (M, S, 1)."""
    each = [bounds.draws_of(scenario, draw, 0, {}).parameters for draw in draws]
    return jax.tree.map(lambda *values: np.stack(values, 1)[:, :, None], *each)


def scored(goals, metrics):
    """Return value and penalty (S, P), and the mean metrics of each search."""
    found = []
    for place, goal in enumerate(goals):
        with devices.on_host():
            own = {name: value[:, place] for name, value in metrics.items()}
            found.append(jax.tree.map(np.asarray, evaluation._scored(goal, own)[1]))
    value, penalty = (np.stack([each[name] for each in found]) for name in ("value", "penalty"))
    return value, penalty, [each["metrics"] for each in found]


class Cell:
    """A case on a robot: its walks, and the rows that there are."""

    def __init__(self, asked, hardware, case):
        """Read the rows that there are."""
        self.asked, self.hardware, self.case = asked, hardware, case
        ideal = mc.load_scenario(f"case_{case}").with_overrides({"duration": asked.seconds} | GRIPS[asked.grips])
        self.scenario = with_hardware(ideal, load_hardware(hardware), hardware)  # with the noise of its sensors
        draw = study.DRAWS[case].model_copy(update={"members": asked.members})
        if asked.varied and hardware != "ideal":
            varied = ensembles.Ensemble.load(f"configs/ensemble_{hardware}.yaml").hardware
            draw = draw.model_copy(update={"hardware": varied})
        self.draws = [draw.model_copy(update={"seed": seed}) for seed in range(asked.seeds)]
        self.checks = [ensembles.fresh(own, ensembles.Use.CHECK) for own in self.draws]
        if asked.nominal:
            self.draws = self.checks = [None] * asked.seeds
        self.unseen = ensembles.fresh(draw).model_copy(update={"members": asked.unseen})
        self.file = asked.out / f"{hardware}_{case}.json"
        self.rows = json.loads(self.file.read_text()) if self.file.exists() else []

    def found(self, law):
        """Return the rows of a law."""
        return [row for row in self.rows if row["law"] == law]

    def keep(self, name, metrics):
        """Keep metrics (M, S) of unseen walks."""
        kept = {metric: np.asarray(metrics[metric], np.float32) for metric in OF_WALKS}
        np.savez_compressed(self.asked.out / f"{self.file.stem}_{name}.npz", **kept)

    def keep_worse(self, name, walks, theta):
        """Keep metrics (setting, M, S) of some unseen walks on worse hardware, as drawn the first."""
        some = self.unseen.model_copy(update={"members": min(self.asked.unseen, WORSE_MEMBERS)})
        drawn = jax.tree.map(lambda values: values[:, 0], of_draws(walks.scenario, [some]))
        each = (degraded.worsened(walks.scenario, drawn, degraded.setting(text)) for text in self.asked.worse)
        found = walks.metrics(walks.gains(theta), degraded.together([drawn, *each], some.members))
        kept = {metric: found[metric].reshape(-1, some.members, len(theta)) for metric in OF_WALKS}
        np.savez_compressed(self.asked.out / f"{self.file.stem}_{name}_{WORSE}.npz", settings=self.asked.worse, **kept)

    @functools.cached_property
    def goal(self):
        """The objective of all walks: relative to pd with the config's gains, on the unseen walks that it survives."""
        walks = Walks(under_pd(self.scenario), shipped("PD"))
        pd = walks.metrics(walks.own((1, self.asked.seeds)), of_draws(self.scenario, [self.unseen]))
        self.keep("as configured", {name: values[:, 0] for name, values in pd.items()})
        there = ~pd["diverged"][:, 0, 0].astype(bool)
        return searched.goal_of(study.WEIGHTS, {name: value[there, 0, 0] for name, value in pd.items()})

    def search(self, name, until):
        """Search a law from all seeds, which ends in time, and walk what was found on unseen walks."""
        began, (law_name, sensors) = time.time(), LAWS[name]
        goals = [searched.with_room(self.goal)] * self.asked.seeds
        if name != "pd":
            goals = [searched.Within(goal, searched.most_of(row["search"]))
                     for goal, row in zip(goals, self.found("pd"), strict=True)]  # fmt: skip
        scenario = under_pd(self.scenario) if name == "pd" else self.scenario.with_overrides(sensors)
        walks = Walks(scenario, shipped(law_name), self.asked.own_gait)
        state = State(self.asked.out / f"{self.file.stem}_{name}.pickle", walks, self.starts(name, walks), self.asked)
        parameters = of_draws(scenario, self.draws)
        while len(state.history) < self.asked.rounds and (time.time() < until or not state.history):
            theta = state.asked()
            value, penalty, _ = scored(goals, walks.metrics(walks.gains(theta), parameters))
            state.told(theta, value + penalty)
        theta = self.checked(walks, state, goals, scenario)
        (of_search,) = (scored(goals, walks.metrics(walks.gains(
            np.repeat(theta[:, None], self.asked.points, 1)), parameters))[2],)  # fmt: skip
        unseen = of_draws(scenario, [self.unseen])
        fresh = walks.metrics(walks.gains(theta[None]), unseen)
        fresh = {metric: value[:, 0] for metric, value in fresh.items()}  # (M, S)
        self.keep(name, fresh)
        if name == "pd" and (friction := scalable(unseen, paths_of(unseen, "friction"))):
            halved = changed(unseen, dict.fromkeys(friction, Factor(0.5)))
            better = walks.metrics(walks.gains(theta[None]), halved)
            self.keep("pd on half the friction", {metric: value[:, 0] for metric, value in better.items()})
        if self.asked.worse:
            self.keep_worse(name, walks, theta)
        with devices.on_host():
            objective = np.asarray(self.goal.score(fresh).value)
        fails = np.asarray(searched.lost(fresh))
        reads = sorted(readings(Problem(scenario, law=walks.law)))
        rows = [row for row in self.rows if row["law"] != name]
        for seed, own in enumerate(theta):
            means = {metric: float(np.nanmean(fresh[metric][:, seed])) for metric in METRICS[1:]}
            means |= {"objective": float(np.nanmean(objective[:, seed])), "lost": float(fails[:, seed].sum())}
            gains = {gain: float(np.ravel(value)[0]) for gain, value in walks.gains(own).items()}
            rows.append({
                "law": name, "seed": seed, "reads": reads, "rounds": len(state.history),
                "restarts": state.restarts[seed], "gains": gains,
                "search": {metric: float(v[0]) for metric, v in of_search[seed].items()},
                "unseen": means, "walks": np.round(objective[:, seed].astype(float), 5).tolist(),
                "history": [round(best[seed], 5) for best in state.history], "seconds": time.time() - began,
            })  # fmt: skip
        self.rows = rows
        self.file.write_text(json.dumps(rows))
        means = ", ".join(f"{row['unseen']['objective']:.4f}" for row in self.found(name))
        print(f"{self.file.stem}, {name}: {means}, lost {fails.sum(0)}, {len(state.history)} rounds, "
              f"{time.time() - began:.0f} s", flush=True)  # fmt: skip

    def starts(self, name, walks):
        """Return the gains that a search begins at, a list (k, n) for each seed."""
        own = start_of(Problem(walks.scenario, walks.space, law=walks.law))
        each = [{}, *known(self.hardware, self.case, name)]
        part = self.found(name.partition("+")[0]) if "+" in name else self.found("pd")
        begins = []
        for seed in range(self.asked.seeds):
            mine = [*each, *([part[seed]["gains"]] if part else [])]
            if "Transfer" in name:
                mine = [gains | {"gait.duty": max(gains.get("gait.duty", 0.0), ON_ALL_FEET)} for gains in mine]
            begins.append([walks.space.from_gains(walks.gains(own) | gains) for gains in mine])
        return begins

    def checked(self, walks, state, goals, scenario):
        """Return the best point (S, n) of each search on its own walks and on others of its seed together."""
        theta, merit = state.best(self.asked.points)
        value, penalty, _ = scored(goals, walks.metrics(walks.gains(theta), of_draws(scenario, self.checks)))
        both = np.nan_to_num(merit + value + penalty, nan=np.inf)
        return theta[np.arange(len(theta)), both.argmin(1)]


class State:
    """The searches of all seeds, kept after each round."""

    def __init__(self, file, walks, starts, asked):
        """Begin, or go on where a file says."""
        self.file, self.points = file, asked.points
        self.low, self.width = walks.space.lower, walks.space.upper - walks.space.lower
        self.starts = [(np.array(own) - self.low) / self.width for own in starts]
        self.optimizers, self.kept = [None] * len(starts), [([], [])] * len(starts)
        self.restarts, self.since, self.history = [0] * len(starts), [[] for _ in starts], []
        if file.exists():
            self.optimizers, self.kept, self.restarts, self.since, self.history = pickle.loads(file.read_bytes())

    def asked(self):
        """Return the next points (S, P, n)."""
        rng, found = np.random.default_rng(0), []
        for own, optimizer in zip(self.starts, self.optimizers, strict=True):
            near = own[np.arange(self.points) % len(own)]
            near = near + NEAR * rng.standard_normal(near.shape)
            near[: len(own)] = own[: self.points]
            found.append(np.clip(near, 0, 1) if optimizer is None else cmaes.drawn(optimizer))
        return self.low + self.width * np.stack(found)

    def told(self, theta, merit):
        """Let the searches learn of points, and keep them; those that stall begin anew."""
        merit = np.where(np.isfinite(merit), merit, 1e6).astype(float)
        unit, kept = (theta - self.low) / self.width, []
        for (points, values), own, new in zip(self.kept, theta, merit, strict=True):
            points, values = np.array([*points, *own]), np.array([*values, *new])
            first = np.argsort(values, kind="stable")[:AHEAD]
            kept.append((points[first], values[first]))
        self.kept = kept
        for seed, (own, values) in enumerate(zip(unit, merit, strict=True)):
            if self.optimizers[seed] is None:
                self.begin(seed, own[values.argmin()], SPREAD)
                continue
            self.optimizers[seed].tell(list(zip(own, values.tolist(), strict=True)))
            best = self.since[seed]
            best.append(min([values.min(), *best[-1:]]))
            if len(best) > PATIENCE and best[-PATIENCE - 1] - best[-1] < FLAT:
                number, starts = self.restarts[seed], self.starts[seed]
                far = (
                    (kept[seed][0][0] - self.low) / self.width if number % 2 == 0 else starts[number // 2 % len(starts)]
                )
                self.restarts[seed] += 1
                self.begin(seed, far, WIDE)
        self.history.append([float(values[0]) for _, values in kept])
        parts = (self.optimizers, self.kept, self.restarts, self.since, self.history)
        self.file.with_suffix(".new").write_bytes(pickle.dumps(parts))
        self.file.with_suffix(".new").replace(self.file)

    def begin(self, seed, mean, spread):
        """Begin a search about a point of the unit box."""
        box, number = np.tile([0.0, 1.0], (len(mean), 1)), self.restarts[seed]
        self.since[seed] = []
        self.optimizers[seed] = CMA(
            mean=mean, sigma=spread, bounds=box, seed=1000 * seed + number, population_size=self.points
        )

    def best(self, count):
        """Return the best points (S, count, n) and their merits."""
        rows = [np.arange(count) % len(values) for _, values in self.kept]
        points, values = ([own[part][row] for own, row in zip(self.kept, rows, strict=True)] for part in (0, 1))
        return np.stack(points), np.stack(values)


def walk(asked):
    """Search the laws of a cell in like shares of the time, pd's half as long; cells in processes of their own."""
    if len(asked.hardware) * len(asked.case) > 1:
        same = ["--began", str(asked.began)]
        each = [[*same, "--hardware", hardware, "--case", case] for hardware in asked.hardware for case in asked.case]
        places = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        running = [subprocess.Popen([sys.executable, *sys.argv, *own], env=places) for own in each]
        return max(process.wait() for process in running)
    cell = Cell(asked, *asked.hardware, *asked.case)
    end = asked.began + 60 * asked.minutes
    left = [name for name in asked.laws if name != "pd" or not cell.found("pd")]
    for place, name in enumerate(left):
        shares, now = [SHARES.get(law, 1.0) for law in left[place:]], time.time()
        cell.search(name, now + (end - now) * shares[0] / sum(shares))
    return 0


def summed(rows):
    """Return a line of the table for each law of a cell: means over its searches, the objective with its interval."""
    lines = []
    laws = list(dict.fromkeys(row["law"] for row in rows))
    values = np.array([[row["walks"] for row in rows if row["law"] == law] for law in laws])  # (G, K, M)
    values = values[..., np.isfinite(values).all((0, 1))]  # a walk that diverges counts as lost
    reading = ["forces" in next(row for row in rows if row["law"] == law)["reads"] for law in laws]
    means = values.mean((1, 2))
    base = min((place for place, reads in enumerate(reading) if not reads), key=lambda place: means[place])
    found = paired.intervals({"": lambda counts: paired.worst_mean(values, counts)}, values.shape[2], base)[""]
    for place, law in enumerate(laws):
        own = [row for row in rows if row["law"] == law]
        line = {"law": law, "reads": " ".join(own[0]["reads"]).replace("base pose", "base_pose"), "seeds": len(own)}
        line |= {name: np.mean([row["unseen"][name] for row in own]) for name in METRICS}
        if line["base_deviation"] > RAN_OFF:
            line |= dict.fromkeys(METRICS[1:], "")
        line |= {"lost": np.mean([row["unseen"]["lost"] for row in own]), "rounds": own[0]["rounds"]}
        line["still"] = np.mean([row["history"][-PATIENCE // 2 :][0] - row["history"][-1] for row in own])
        line |= {"beside": laws[base], "difference": found.difference[place]}
        lines.append(line | {"low": found.low[place], "high": found.high[place]})
    return lines


def table(asked):
    """Write all rows as one table, and print the page's."""
    lines, gains = [], []
    for hardware, case in itertools.product(HARDWARE, study.CASES):
        file = asked.out / f"{hardware}_{case}.json"
        if file.exists():
            rows = json.loads(file.read_text())
            lines += [{"servos": hardware, "case": case} | line for line in summed(rows)]
            for law in dict.fromkeys(row["law"] for row in rows):  # the best on the walks of its search
                best = min((row for row in rows if row["law"] == law), key=lambda row: row["history"][-1])
                gains += [(hardware, case, law, name, f"{value:.4g}") for name, value in best["gains"].items()
                          if name not in mc.Gains.AXES]  # fmt: skip
    with asked.table.open("w", newline="") as out:
        writer = csv.DictWriter(out, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in line.items()} for line in lines)
    with asked.table.with_name(f"{asked.table.stem}_gains.csv").open("w", newline="") as out:
        csv.writer(out, lineterminator="\n").writerows([("servos", "case", "law", "gain", "value"), *gains])
    print(*figures.worth_rows(list(csv.DictReader(asked.table.open()))), sep="\n")


def main():
    """Walk, or write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--table", type=Path, help="write this file from the rows that there are, and walk nothing")
    parser.add_argument("--grips", choices=list(GRIPS), default="at once")
    parser.add_argument("--hardware", nargs="+", default=list(HARDWARE))
    parser.add_argument("--case", nargs="+", default=list(study.CASES))
    parser.add_argument("--laws", nargs="+", default=list(LAWS)[:6], help=f"of {', '.join(LAWS)}; pd first")
    parser.add_argument("--varied", action="store_true", help="draw the hardware, as configs/ensemble_*.yaml does")
    parser.add_argument("--own-gait", action="store_true", help="walk with the config's gait")
    parser.add_argument("--nominal", action="store_true", help="search on the case's own walk alone")
    parser.add_argument("--worse", nargs="+", default=[], help="settings as of `mjx-climb evaluate --worse`")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--minutes", type=float, default=8.0, help="from `--began` on, in which searches end")
    parser.add_argument("--began", type=float, default=time.time(), help="s since 1970")
    parser.add_argument("--members", type=int, default=64, help="walks of a search")
    parser.add_argument("--points", type=int, default=40, help="of a round and seed")
    parser.add_argument("--rounds", type=int, default=10_000, help="at most")
    parser.add_argument("--unseen", type=int, default=512)
    parser.add_argument("--seconds", type=float, default=8.0)
    asked = parser.parse_args()
    if asked.table is not None:
        table(asked)
        return 0
    asked.out.mkdir(parents=True, exist_ok=True)
    return walk(asked)


if __name__ == "__main__":
    sys.exit(main())
