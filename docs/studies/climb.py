"""How far robots climb: 2 m of random rock at five angles under lunar gravity, and along handrails in microgravity.

    python docs/studies/climb.py results/climb [--grounds 256] [--only best_margin] [--only closing-waits]
    python docs/studies/climb.py results/small --grounds 2 --way 0.1 --angles 135 --densities 400

Rows are robots, grounds, laws, rules of choice, contacts and gaits; each walks all angles, densities and grounds in one
program. A climb succeeds if the base comes 2 m ahead before a grip is torn off. `climb.csv`, written after each row,
has the successes with intervals of 95 % (Wilson) and what ended the others first. Rows that have been walked are not
walked again; several processes may share the rows and the folder.

A grip closes, or holds at once, wherever it shuts, or fails a test of 12 N in a quarter of its tries. The gait waits
for grips, or goes on.
"""

import argparse
import csv
import dataclasses
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

import mjx_climb as mc
from mjx_climb.control import LoadTransfer
from mjx_climb.ground import Holds, holds_of_seeds
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.walk.metrics import Context, Metric
from mjx_climb.walk.sample import Sample

WAY = 2.0  # m
LUNAR, MICRO = 1.62, 9.81e-6  # m/s^2
ANGLES = (0, 45, 90, 135, 180)  # degrees, from the floor to the ceiling
# points for each square metre of rock, and m between points of a rail
DENSITIES = {"rock": (120.0, 200.0, 400.0), "rails": (0.1, 0.05, 0.02, 0.01)}
WIDTH = {"hubrobo": 0.5, "hexapod": 0.6}  # m, of the rock
BETWEEN = {"hubrobo": 0.28, "hexapod": 0.2866}  # m, from rail to rail
Row = tuple[str, str, str, str, str, str]  # robot, ground, law, rule, contact, gait
CONTACTS: dict[str, dict[str, object]] = {  # changes of the config's
    "closing": {},
    "at once": {"contact.closing_time": 0.0, "contact.capture_distance": None},
    # another kind of contact begins with values of its own
    "failing": {
        "contact": {
            "kind": "uncertain",
            "capture_distance": 0.005,
            "closing_time": 0.1,
            "tested_pull": 12.0,
            "spread": 0.3,
            "tries": 2.0,
        },
    },
}
GAITS = {"waits": True, "goes on": False}
SPARE = {"closing": 1.15, "at once": 1.15, "failing": 1.6}  # times of the gait
FAILING = 64  # grounds of grips that fail
REASONS = ("arrived", "stuck", "out of reach", "torn off", "diverged", "stands")
_RULES = ("nearest", "best_margin", "least_use")
_WALKERS: tuple[tuple[str, str, str, str], ...] = (
    *(("hubrobo", "rock", "base_admittance", rule) for rule in _RULES),
    *(("hubrobo", "rock", "load_transfer", rule) for rule in ("best_margin", "least_use")),
    *(("hexapod", "rock", "base_admittance", rule) for rule in _RULES),
    ("hubrobo", "rock", "pd", "best_margin"),
    *(("hubrobo", "rock", "base_admittance", rule) for rule in ("best_margin free", "climblab", "climblab free")),
    *(("hubrobo", "rails", law, "nearest") for law in ("base_admittance", "pd", "load_transfer")),
    ("hexapod", "rails", "base_admittance", "nearest"),
)
ROWS: tuple[Row, ...] = (
    *((*walker, "closing", "waits") for walker in _WALKERS),
    *((*_WALKERS[2], "failing", gait) for gait in GAITS),
    *((*walker, contact, "goes on") for contact in ("closing", "at once") for walker in _WALKERS[:3]),
    *((*walker, "at once", "goes on") for walker in _WALKERS[3:] if walker[1] == "rock"),
)
KEPT = ("reason", "held_way", "detached_limb", "peak_pull_force", "missed_grips")  # of each climb


def _first(at: Array, happens: Array, now: Array) -> Array:
    return jnp.where(jnp.isnan(at) & happens, now, at)


def along(way: float) -> tuple[Metric, Metric]:
    """Return when the base was so far ahead, m, and how far it came, both before a grip was torn off."""

    def begun(zero: Array) -> tuple[Array, ...]:
        return zero + jnp.nan, zero + jnp.nan, zero, zero < 0

    def update(running: tuple[Array, ...], sample: Sample, _: Context) -> tuple[Array, ...]:
        start, arrived, far, lost = running
        start = jnp.where(jnp.isnan(start), sample.base_position[0], start)
        # a gripper that was torn off may grip again
        ahead, lost = sample.base_position[0] - start, lost | sample.torn_off.any()
        return start, _first(arrived, ~lost & (ahead >= way), sample.time), jnp.where(lost, far, ahead), lost

    return (
        Metric("arrived_at", "s", "arrived at", False, begun, update, lambda running, _: running[1]),
        Metric("held_way", "m", "way until a grip is torn off", True, begun, update, lambda running, _: running[2]),
    )


UNREACHED = Metric(
    "unreached_at", "s", "a target is out of reach at", True, lambda zero: zero + jnp.nan,
    lambda at, sample, _: _first(at, ~sample.reachable.all(), sample.time),
)  # fmt: skip


def scenario_of(
    robot: str, law: str, rule: str, way: float, contact: str = "closing", gait: str = "waits"
) -> mc.Scenario:
    """Return the scenario of a row; seeds, density and gravity are given beside it."""
    scenario = mc.load_scenario("configs/climb_rock.yaml")
    rule, _, order = rule.partition(" ")
    keys = CONTACTS[contact] | {"gait.footholds": rule, "gait.order": order or "periodic"}
    keys["gait.waiting.waits"] = GAITS[gait]
    if rule == "climblab":  # its planner heads for a goal
        keys["gait.way_points"] = [[5.0, 0.0]]
    speed = scenario.gait.stride / scenario.gait.cycle
    keys["duration"] = float(np.ceil(10 * SPARE[contact] * way / speed) / 10)
    if law == "pd":
        keys["control.controller"] = "pd"
    if robot == "hexapod":
        six = mc.load_scenario("configs/hexapod_ceiling.yaml")
        keys |= {"robot": six.robot, "gait.duty": six.gait.duty, "gait.sequence": six.gait.sequence}
        keys |= {"gait.step_height": six.gait.step_height, "control.kp": six.control.kp, "control.kd": six.control.kd}
    return scenario.with_overrides(keys)


def grounds(scenario: mc.Scenario, robot: str, ground: str, seeds: range, densities: Sequence[float]) -> Holds:
    """Return holds with axes (density, seed) in front."""
    width, between = WIDTH[robot], BETWEEN[robot]
    most = max(DENSITIES["rock"]) * 3.0 * width if ground == "rock" else 2 * (3.0 / min(DENSITIES["rails"]) + 2)
    found = []
    for density in densities:
        keys: dict[str, object] = {"ground.holds.count": int(np.ceil(most))}
        if ground == "rock":
            keys |= {"ground.holds.rock.density": density, "ground.holds.rock.size": [3.0, width]}
            keys["ground.holds.rock.corner"] = [-0.4, -width / 2]
        else:
            rails = {"rails": 2, "pitch": density, "corner": [-0.4, -between / 2], "size": [3.0, between]}
            keys |= {"ground.holds.rock": None, "ground.holds.handrails": rails}
        each = holds_of_seeds(scenario.with_overrides(keys).ground, seeds)
        if ground == "rails":  # that begin anywhere within a pitch
            shift = density * np.random.default_rng(seeds.start).random(len(seeds))
            position = np.array(each.position)
            position[..., 0] += shift[:, None]
            each = dataclasses.replace(each, position=position)
        found.append(each)
    return Holds(**{name: np.stack([getattr(each, name) for each in found]) for name in Holds.VALUES})


def climbed(row: Row, seeds: range, asked: argparse.Namespace) -> dict[str, np.ndarray]:
    """Return the `KEPT` metrics of climbs, (angle, density, seed) each; a reason is its index in `REASONS`."""
    robot, ground, law, rule, contact, gait = row
    scenario = scenario_of(robot, law, rule, asked.way, contact, gait)
    angle = np.radians(angles_of(ground, asked))
    size = LUNAR if ground == "rock" else MICRO
    gravity = size * np.stack([-np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    holds = grounds(scenario, robot, ground, seeds, densities_of(ground, asked))
    values: dict[str, object] = {"gravity": gravity[:, None, None]}
    if contact == "failing":
        values["contact.seed"] = np.asarray(seeds, float)
    parameters = own_parameters(scenario).replace(values)
    parameters = dataclasses.replace(parameters, ground=dataclasses.replace(parameters.ground, holds=holds))
    own = LoadTransfer() if law == "load_transfer" else None
    simulation = mc.Simulation(scenario, own, (*mc.METRICS, *along(asked.way), UNREACHED))
    found = simulation.metrics(None, parameters, unsteady=True)
    arrived, torn, out = (found[name] for name in ("arrived_at", "detached_at", "unreached_at"))
    late = ~np.isnan(out) & ~(out > torn)
    failed = np.select(
        [~np.isnan(torn) & late, ~np.isnan(torn), found["diverged"] > 0, found["stands_at"] >= 0], [2, 3, 4, 5], 1
    )
    found["reason"] = np.where(np.isnan(arrived), failed, 0)
    return {name: found[name] for name in KEPT}


def angles_of(ground: str, asked: argparse.Namespace) -> Sequence[float]:
    """Return the angles of a ground that are walked, degrees."""
    return (asked.angles or ANGLES) if ground == "rock" else (0,)


def densities_of(ground: str, asked: argparse.Namespace) -> Sequence[float]:
    """Return the densities of a ground that are walked."""
    return asked.densities or DENSITIES[ground]


def wilson(count: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """Return the interval of 95 % of a share."""
    share, more = count / of, z * z / of
    middle, half = share + more / 2, z * np.sqrt(share * (1 - share) / of + more / (4 * of))
    return (middle - half) / (1 + more), (middle + half) / (1 + more)


def table_of(row: Row, climbs: dict[str, np.ndarray], asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of the table, one for each angle and density."""
    table = []
    for place in np.ndindex(climbs["reason"].shape[:2]):
        own = {name: value[place] for name, value in climbs.items()}
        count, of = int((own["reason"] == 0).sum()), own["reason"].size
        low, high = wilson(count, of)
        limbs = np.bincount(own["detached_limb"][own["reason"] >= 2].astype(int) + 1, minlength=7)[1:]
        table.append(
            dict(zip(("robot", "ground", "law", "rule", "contact", "gait"), row, strict=True))
            | {"angle": angles_of(row[1], asked)[place[0]] if row[1] == "rock" else ""}
            | {"density": densities_of(row[1], asked)[place[1]]}
            | {"arrived": count, "of": of, "95 % low": f"{low:.3f}", "95 % high": f"{high:.3f}"}
            | {name: int((own["reason"] == n).sum()) for n, name in enumerate(REASONS) if n}
            | {"missed grips": int(own["missed_grips"].sum())}
            | {"median way m": f"{np.nanmedian(own['held_way']):.3g}", "limbs torn off": " ".join(map(str, limbs))}
            | {"median peak pull N": f"{np.nanmedian(own['peak_pull_force']):.3g}"}
        )
    return table


def named(row: Row) -> str:
    """Return the name of a row's file."""
    return "-".join(row).replace(" ", "_")


def written(asked: argparse.Namespace) -> None:
    """Write the table of all rows that have been walked."""
    files = {row: asked.out / f"{named(row)}.npz" for row in ROWS}
    table = [each for row, kept in files.items() if kept.exists() for each in table_of(row, dict(np.load(kept)), asked)]
    unfinished = asked.out / f"climb.{os.getpid()}.csv"
    with unfinished.open("w", newline="") as target:
        writer = csv.DictWriter(target, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    unfinished.replace(asked.out / "climb.csv")


def main() -> None:
    """Walk all rows and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--grounds", type=int, default=256)
    parser.add_argument("--way", type=float, default=WAY, help="m")
    parser.add_argument("--only", nargs="+", default=[""], help="rows whose names, joined by dashes, have one in them")
    parser.add_argument("--angles", type=int, nargs="+", help="degrees, of rock")
    parser.add_argument("--densities", type=float, nargs="+")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    for row in ROWS:
        kept = asked.out / f"{named(row)}.npz"
        if kept.exists() or not any(part in named(row) for part in asked.only):
            continue
        count = min(asked.grounds, FAILING) if row[4] == "failing" else asked.grounds
        climbs = climbed(row, range(count), asked)
        unfinished = kept.with_suffix(f".{os.getpid()}.npz")
        np.savez_compressed(unfinished, **climbs)
        unfinished.replace(kept)
        shares = [f"{each['angle']}/{each['density']:g} {each['arrived']}" for each in table_of(row, climbs, asked)]
        print(f"{time.time() - begun:.0f} s: {named(row)} of {count}: {', '.join(shares)}", flush=True)
        written(asked)


if __name__ == "__main__":
    main()
