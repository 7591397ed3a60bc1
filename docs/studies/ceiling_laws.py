"""Laws that close the gap to the ceiling: searched for its objective, and walked on draws that no search has seen.

    python docs/studies/ceiling_laws.py results/laws 1_2 transfer feet [--minutes 12] [--members 32]

The steps of a case, each from the gains file that the one before it left, or from the shipped gains:

    pd, transfer, even, base, end_effector, internal
                           a law's gains, joint gains and gait by CMA-ES; after pd within its means of all metrics
    feet_pd, feet          `PlannedFeet` beside pd, beside load transfer: by gradients
    network_pd, network    the network of docs/guides/network_law.py beside pd, beside load transfer: by gradients
    memory_pd, memory      the network with memory of learned_law.py, likewise
    blind, clairvoyant     `TimedFeet` beside pd: one plan for all walks, and a plan of each

Gradients are those of an adjoint where a law has more than 24 numbers.
"""

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

import jax
import numpy as np
import yaml

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "guides")]

import ceiling as study
from even_transfer import EvenTransfer
from learned_law import Remembering
from network_law import Network
from planned_feet import PlannedFeet, TimedFeet

import mjx_climb as mc
import tuning
from mjx_climb.control import PD, EndEffectorAdmittance, LoadTransfer, VirtualModelAdmittance, combined
from mjx_climb.control.internal_force import InternalForce
from mjx_climb.inputs.gait_values import GAIT, scenario_with_gait
from tuning.gains import gains_file
from tuning.methods.many_variables import Evaluated, descend
from tuning.problem import ensemble as ensembles
from tuning.problem import spaces
from tuning.problem.ceiling import Ceiling
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.objectives import Limit, Objective, Score, lost, penalty_of
from tuning.problem.plans import RATE, SWING
from tuning.problem.search import Search
from tuning.results.tuned import AGREEMENT
from tuning.searches import ceiling as bounds
from tuning.searches.tune import start_of

TABLE = mc.MetricTable((*mc.METRICS, SWING, RATE))
ALSO = tuple(name for name in GAIT if name != "gait.stride")
LAWS = {"pd": PD, "transfer": LoadTransfer, "even": EvenTransfer, "base": VirtualModelAdmittance,
        "end_effector": EndEffectorAdmittance, "internal": InternalForce}  # fmt: skip
SHIPPED = {"pd": "_pd", "transfer": "_best", "even": "_best", "base": ""}  # ends of the names of gains files
ADDED = {"feet": PlannedFeet, "network": Network, "memory": Remembering, "blind": TimedFeet, "clairvoyant": TimedFeet}
UNSEEN, MOST, WAY, STAGES, LATE = 512, 1500, 0.02, 4, 45.0
# the penalty of a pull begins so far below the holding limit; a mean may be so much above pd's, and its penalty begins
# so far below
PULL_MARGIN, WORSE, MARGIN = 0.2, 0.02, 0.01
KEPT = (*study.WEIGHTS, "peak_pull_force", "base_deviation", "swing_deviation", "travel")


def goals_on(scenario, weights, *draws):
    """Return the objective of `tuning.ceiling` over the walks of each draw, with the way that pd goes held."""
    drawn = [bounds.draws_of(scenario, draw, 0, {}).parameters for draw in draws]
    together = jax.tree.map(lambda *each: np.concatenate(each), *drawn)
    pd = mc.Simulation(under_pd(scenario), metrics=TABLE, smooth=True).metrics({}, together, unsteady=True)
    ends = np.cumsum([draw.members for draw in draws])
    return [
        goal_of(weights, {name: value[end - draw.members : end] for name, value in pd.items()})
        for draw, end in zip(draws, ends, strict=True)
    ]


def goal_of(weights, pd):
    """Return the objective of `tuning.ceiling` over walks, with the way that pd goes held, by pd's metrics there."""
    goal, way = bounds._objective(Ceiling(weights=weights), pd, TABLE), pd["travel"].mean()
    held = [Limit("travel", float(way * (1 + side * WAY)), float(way), 0.1 * WAY, "pd's", side < 0) for side in (-1, 1)]
    return dataclasses.replace(goal, limits=(*goal.limits, *held))


def with_room(goal):
    """Return an objective whose penalty of a pull begins well below the holding limit."""
    return dataclasses.replace(goal, limits=tuple(
        limit._replace(margin=PULL_MARGIN) if limit.metric == "peak_utilization" else limit for limit in goal.limits
    ))  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Within:
    """An objective over an ensemble, (members, B) metrics, whose means over the members have limits too."""

    each: Objective
    most: tuple[tuple[str, float], ...]

    @property
    def limits(self):
        """The limits of each walk."""
        return self.each.limits

    def score(self, metrics):
        """Return the scores (B,) of points."""
        value, descent, penalty, feasible = self.each.score(metrics)
        value, descent, penalty, feasible = value.mean(0), descent.mean(0), penalty.mean(0), feasible.all(0)
        for name, most in self.most:
            over = metrics[name].mean(0) / most - 1
            penalty, feasible = penalty + penalty_of(over + MARGIN), feasible & (over <= 0)
        return Score(value, descent, penalty, feasible)


def most_of(means):
    """Return the limits of the means of a law's metrics, by those of pd."""
    names = (*study.WEIGHTS, "peak_pull_force", "base_deviation")
    return tuple((name, (1 + WORSE) * float(means[name])) for name in names)


def read(file):
    """Return the gains of a file by name, gait and joint gains among them, at the scenario's speed of travel."""
    own = yaml.safe_load(file.read_text()) if file.exists() else {}
    gait = {f"gait.{name}": value for name, value in own.get("gait", {}).items() if name != "stride"}
    return {name: value for name, value in own.items() if name not in ("law", "gait")} | gait


def begun(scenario, own, kind):
    """Return scenario and law with gains by name as their own."""
    law = LAWS[kind]()
    law = dataclasses.replace(law, **{name: np.asarray(own[name], float) for name in law.GAINS if name in own})
    joint = {f"control.{name}": float(own[name]) for name in ("kp", "kd") if name in own}
    return scenario_with_gait(scenario.with_overrides(joint), {name: own[name] for name in GAIT if name in own}), law


def values(problem, theta):
    """Return objective and metrics of a point in each of the unseen walks, and which are lost."""
    gains = spaces.to_gains64(problem.space, theta)
    return of_walks(problem, problem.simulation.metrics(gains, **problem._how))


def of_walks(problem, found):
    """Return objective and metrics of walks, and which are lost."""
    score = problem.objective.score({name: np.asarray(value) for name, value in found.items()})
    kept = {name: np.asarray(found[name]) for name in KEPT} | {"objective": np.asarray(score.value)}
    kept["lost"] = lost({name: np.asarray(found[name]) for name in ("peak_utilization", "diverged")})
    return {name: value.reshape(-1).astype(np.float32) for name, value in kept.items()}


def means(walks):
    """Return the means of what `values` gave."""
    return {name: float(value.mean()) for name, value in walks.items()}


def descended(problem, theta, until, log):
    """Return the best point of each problem and its merit, from descents with ever smaller steps that end in time."""
    along, count, best, least = np.eye(problem.space.size), 0, theta, np.full(len(theta), np.inf)

    def evaluate(x, sharp):
        nonlocal count, best, least
        if count and time.time() > until + LATE:
            raise TimeoutError
        found = problem.evaluate(problem.space.clip(x), along)
        better = found.merit < least
        best, least = np.where(better[:, None], problem.space.clip(x), best), np.where(better, found.merit, least)
        count += 1
        log(count, float(found.merit.mean()), float(found.value.mean()), best, least)
        return Evaluated(found.merit, (1 - sharp) * found.gradient + sharp * found.sharp)

    evaluate(theta, 0.0)  # compiles
    try:
        for left in range(STAGES, 0, -1):  # how long an evaluation takes depends on who else walks on this GPU
            begin, done = time.time(), count
            evaluate(best, 0.0)
            each = time.time() - begin
            evaluations = int(np.clip((until - time.time()) / left / each, 2, MOST))
            descend(evaluate, best, evaluations, step=0.06 * 0.5 ** (STAGES - left), known=least)
            print(f"  {(time.time() - begin) / (count - done):.2f} s an evaluation", flush=True)
    except TimeoutError:
        print("  stopped late", flush=True)
    return best, least


def main():
    """Go through the steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("case")
    parser.add_argument("steps", nargs="+")
    parser.add_argument("--hardware", default="dynamixel_x")
    parser.add_argument("--members", type=int, default=64)
    parser.add_argument("--unseen", type=int, default=UNSEEN)
    parser.add_argument("--seed", type=int, default=0, help="of the walks that are searched on")
    parser.add_argument("--minutes", type=float, default=12.0, help="for all steps together")
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--rounds", type=int, default=150, help="of CMA-ES")
    parser.add_argument("--points", type=int, default=128, help="of a round")
    parser.add_argument("--seeds", type=int, default=3, help="searches by CMA-ES, of which the best is kept")
    parser.add_argument("--weight", action="append", default=[], help="METRIC=W in place of the ceiling's metrics")
    parser.add_argument("--longer", type=float, default=16.0, help="s, of the walks that end the study; 0: none")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    began = time.time()
    case, hardware = asked.case, asked.hardware
    scenario = study.scenario_of(hardware, case, asked.seconds)
    draw = study.DRAWS[case].model_copy(update={"members": asked.members})
    unseen = ensembles.fresh(draw).model_copy(update={"members": asked.unseen})
    draw = draw.model_copy(update={"seed": draw.seed + asked.seed})
    weights = {name: float(weight) for name, weight in (text.split("=") for text in asked.weight)} or study.WEIGHTS
    goal, judges = goals_on(scenario, weights, draw, unseen)
    goal = with_room(goal)
    ended = []
    for place, step in enumerate(asked.steps):
        until = began + 60 * asked.minutes * (place + 1) / len(asked.steps)
        stem = asked.out / f"{hardware}_{case}_{step}"
        print(f"{stem.name}, {time.time() - began:.0f} s", flush=True)
        kind, _, of = step.partition("_")
        of = of or dict.fromkeys(("feet", "network", "memory"), "transfer").get(kind, "pd")
        kind, of = (step, step) if step in LAWS else (kind, of)
        own = {name: read(asked.out / f"{hardware}_{case}_{name}.yaml") for name in ("pd", "transfer", of)}
        shipped = read(Path(f"configs/gains/{hardware}_case_{case}{SHIPPED.get(of, '_none')}.yaml"))
        begin = shipped | own["pd"] | (own["transfer"] if of == "even" else {})
        changed, law = begun(scenario, own[of] or begin, of)
        changed = under_pd(changed) if of == "pd" else changed
        if kind in ADDED:
            law = combined(law, ADDED[kind]()) if of != "pd" else ADDED[kind]()
        how = {"space": "isotropic", "joint_gains": kind not in ("blind", "clairvoyant"), "precision": "float32"}
        each = ensembles.draw(changed, draw)
        lines, agreement = [], ""

        def log(count, merit, value, best=None, least=None, lines=lines, stem=stem):
            lines.append([count, round(time.time() - began, 1), merit, value])
            if count % 20 == 1:
                if best is not None:
                    np.savez_compressed(stem.with_suffix(".npz"), theta=best.astype(np.float32), merit=least)
                stem.with_suffix(".log.json").write_text(json.dumps(lines))
                print(f"  {count}: {merit:.4f} {value:.4f}, {time.time() - began:.0f} s", flush=True)

        own_limits = {"also": (*ALSO, *(("pull_limit",) if "pull_limit" in law.GAINS else ()))}
        cycle = changed.gait.cycle  # a walk has a whole one
        own_limits["bounds"] = {"gait.cycle": (cycle / 2, max(cycle, min(2 * cycle, asked.seconds)))}
        wanted = Search(**how, **(own_limits if kind in LAWS else {}))
        space = spaces.space(changed, wanted, law)
        fresh = Problem(changed, space, objective=judges, parameters=ensembles.draw(changed, unseen), law=law,
                        members=asked.unseen, metrics=TABLE)  # fmt: skip
        start = values(fresh, start_of(fresh)[None])  # compiles what the end needs too
        print(f"  {json.dumps(means(start))}, {time.time() - began:.0f} s", flush=True)
        if kind in LAWS:
            held, pd = Within(goal, ()), asked.out / f"{hardware}_{case}_pd.json"
            if kind != "pd" and pd.exists():
                held = Within(goal, most_of(json.loads(pd.read_text())["search"]))

            def told(now, until=until, log=log):
                log(now.rounds, now.best, now.best)
                if time.time() > until:
                    raise KeyboardInterrupt  # ends the search with what it has

            found = tuning.tune(
                changed, wanted, seeds=asked.seeds, law=law, objective=held, metrics=TABLE, parameters=each,
                method="cmaes", starts=asked.points, iterations=asked.rounds, progress=told,
            )  # fmt: skip
            gains, agreement = found.gains, found.data.attrs.get(AGREEMENT, "")
            theta = space.from_gains(gains)[None]
        else:
            theta = start_of(Problem(changed, space, law=law))[None]
            problem = Problem(
                changed, space, objective=goal, parameters=each, members=asked.members, metrics=TABLE, law=law
            )
            if kind == "clairvoyant":
                earlier = asked.out / f"{hardware}_{case}_blind.npz"
                theta = np.load(earlier)["theta"] if earlier.exists() else theta
                theta = np.repeat(theta, asked.members, 0)
                problem = dataclasses.replace(
                    problem, parameters=bounds.draws_of(changed, draw, 0, {}).parameters, members=1
                )
            theta, merit = descended(problem, theta, until, log)
            gains = space.to_gains(theta[0])
            np.savez_compressed(stem.with_suffix(".npz"), theta=theta.astype(np.float32), merit=merit)
        if kind != "clairvoyant":
            gains_file.save(gains, stem.with_suffix(".yaml"), f"{step}, searched for the ceiling of {case}", law)
            end = values(fresh, theta)
            of_search = dataclasses.replace(fresh, objective=goal, parameters=each, members=asked.members)
            summary = {"unseen": means(end), "start": means(start), "search": means(values(of_search, theta))}
            summary["seeds"] = agreement
            ended.append((stem, changed, law, gains))
            np.savez_compressed(asked.out / f"{stem.name}_unseen.npz", **end)
        else:
            summary = {"merit": merit.tolist(), "objective": float(merit.mean())}
        summary["seconds"] = time.time() - began
        stem.with_suffix(".json").write_text(json.dumps(summary, indent=1))
        stem.with_suffix(".log.json").write_text(json.dumps(lines))
        print(json.dumps(summary), flush=True)
    for stem, changed, law, gains in ended if asked.longer else ():
        if time.time() < began + 60 * asked.minutes:
            summary = longer(scenario, unseen, weights, asked.longer, changed, law, gains)
            summary |= json.loads(stem.with_suffix(".json").read_text())
            stem.with_suffix(".json").write_text(json.dumps(summary, indent=1))


def longer(scenario, unseen, weights, seconds, changed, law, gains):
    """Return the means of unseen walks of some s."""
    scenario, changed = (each.with_overrides({"duration": seconds}) for each in (scenario, changed))
    (judges,) = goals_on(scenario, weights, unseen)
    fresh = Problem(changed, objective=judges, parameters=ensembles.draw(changed, unseen), law=law,
                    members=unseen.members, metrics=TABLE)  # fmt: skip
    found = fresh.simulation.metrics(gains, **fresh._how)
    return {f"{seconds:g} s": means(of_walks(fresh, found))}


if __name__ == "__main__":
    main()
