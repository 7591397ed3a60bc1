"""How far robots climb: 2 m of random rock at five angles under lunar gravity, and along handrails in microgravity.

    python docs/studies/climb.py results/climb [--grounds 256] [--at-once 256] [--only best_margin] [--contact closing]
    python docs/studies/climb.py results/contacts --grounds 16 --contact closing --angles 135 180 --densities 400

Rows are robots, grounds, laws and rules of choice; each walks all angles, densities and grounds in one program. A climb
succeeds if the base comes 2 m ahead before a grip is torn off. `climb.csv` has the successes with intervals of 95 %
(Wilson) and what ended the others first. Grounds that have been walked already are not walked again. `--contact` takes
the grip that closes, with a gait that waits for it, or the one that holds at once, wherever it shuts.
"""

import argparse
import csv
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

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
Kind = tuple[str, str, str, str]  # robot, ground, law, rule
CONTACTS: dict[str, dict[str, object]] = {
    "closing": {},
    "at_once": {"contact.closing_time": 0.0, "contact.capture_distance": None, "gait.waiting.waits": False},
}
REASONS = ("arrived", "stuck", "out of reach", "torn off", "diverged", "stands")
ROWS: tuple[Kind, ...] = (
    ("hubrobo", "rock", "base_admittance", "best_margin"),
    ("hubrobo", "rock", "pd", "best_margin"),
    ("hubrobo", "rails", "base_admittance", "nearest"),
    ("hexapod", "rock", "base_admittance", "nearest"),
    ("hubrobo", "rock", "load_transfer", "best_margin"),
    *(
        ("hubrobo", "rock", "base_admittance", rule)
        for rule in ("nearest", "climblab", "climblab free", "best_margin free")
    ),
    ("hexapod", "rails", "base_admittance", "nearest"),
    *(("hubrobo", "rails", law, "nearest") for law in ("pd", "load_transfer")),
    ("hexapod", "rock", "base_admittance", "best_margin"),
    *(("hubrobo", "rock", law, "least_use") for law in ("base_admittance", "load_transfer")),
    ("hexapod", "rock", "base_admittance", "least_use"),
)
KEPT = ("reason", "held_way", "detached_limb", "peak_pull_force")  # of each climb


def _first(at: Array, happens: Array, now: Array) -> Array:
    return jnp.where(jnp.isnan(at) & happens, now, at)


def _begun(zero: Array) -> tuple[Array, Array, Array]:
    return zero + jnp.nan, zero + jnp.nan, zero


def along(way: float) -> tuple[Metric, Metric]:
    """Return when the base was so far ahead, m, and how far it came, both before a grip was torn off."""

    def update(running: tuple[Array, Array, Array], sample: Sample, _: Context) -> tuple[Array, Array, Array]:
        start, arrived, far = running
        start = jnp.where(jnp.isnan(start), sample.base_position[0], start)
        ahead, held = sample.base_position[0] - start, ~(sample.detached | sample.torn_off).any()
        return start, _first(arrived, held & (ahead >= way), sample.time), jnp.where(held, ahead, far)

    return (
        Metric("arrived_at", "s", "arrived at", False, _begun, update, lambda running, _: running[1]),
        Metric("held_way", "m", "way until a grip is torn off", True, _begun, update, lambda running, _: running[2]),
    )


UNREACHED = Metric(
    "unreached_at", "s", "a target is out of reach at", True, lambda zero: zero + jnp.nan,
    lambda at, sample, _: _first(at, ~sample.reachable.all(), sample.time),
)  # fmt: skip


def scenario_of(robot: str, law: str, rule: str, way: float, contact: str = "closing") -> mc.Scenario:
    """Return the scenario of a row; seeds, density and gravity are given beside it."""
    scenario = mc.load_scenario("configs/climb_rock.yaml")
    rule, _, order = rule.partition(" ")
    keys = CONTACTS[contact] | {"gait.footholds": rule, "gait.order": order or "periodic"}
    speed = scenario.gait.stride / scenario.gait.cycle
    keys["duration"] = float(np.ceil(11.5 * way / speed) / 10)
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


def climbed(row: Kind, seeds: range, asked: argparse.Namespace) -> dict[str, np.ndarray]:
    """Return the `KEPT` metrics of climbs, (angle, density, seed) each; a reason is its index in `REASONS`."""
    robot, ground, law, rule = row
    scenario = scenario_of(robot, law, rule, asked.way, asked.contact)
    angle = np.radians(angles_of(ground, asked))
    size = LUNAR if ground == "rock" else MICRO
    gravity = size * np.stack([-np.sin(angle), 0 * angle, -np.cos(angle)], axis=-1)
    holds = grounds(scenario, robot, ground, seeds, densities_of(ground, asked))
    parameters = own_parameters(scenario).replace({"gravity": gravity[:, None, None]})
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


def written(path: Path, rows: list[dict[str, object]]) -> None:
    """Write a table."""
    with path.open("w", newline="") as target:
        writer = csv.DictWriter(target, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def table_of(row: Kind, climbs: dict[str, np.ndarray], asked: argparse.Namespace) -> list[dict[str, object]]:
    """Return the rows of the table, one for each angle and density."""
    robot, ground, law, rule = row
    table = []
    for place in np.ndindex(climbs["reason"].shape[:2]):
        own = {name: value[place] for name, value in climbs.items()}
        count, of = int((own["reason"] == 0).sum()), own["reason"].size
        low, high = wilson(count, of)
        limbs = np.bincount(own["detached_limb"][own["reason"] >= 2].astype(int) + 1, minlength=7)[1:]
        table.append(
            {"robot": robot, "ground": ground, "law": law, "rule": rule, "contact": asked.contact.replace("_", " ")}
            | {"angle": angles_of(ground, asked)[place[0]] if ground == "rock" else ""}
            | {"density": densities_of(ground, asked)[place[1]]}
            | {"arrived": count, "of": of, "95 % low": f"{low:.3f}", "95 % high": f"{high:.3f}"}
            | {name: int((own["reason"] == n).sum()) for n, name in enumerate(REASONS) if n}
            | {"median way m": f"{np.nanmedian(own['held_way']):.3g}", "limbs torn off": " ".join(map(str, limbs))}
            | {"median peak pull N": f"{np.nanmedian(own['peak_pull_force']):.3g}"}
        )
    return table


def named(row: Kind, asked: argparse.Namespace) -> str:
    """Return the name of a row's file."""
    return "-".join((*row, asked.contact)).replace(" ", "_")


def main() -> None:
    """Walk all rows and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--grounds", type=int, default=256)
    parser.add_argument("--at-once", type=int, default=256, help="grounds that are walked before results are written")
    parser.add_argument("--way", type=float, default=WAY, help="m")
    parser.add_argument("--only", default="", help="rows whose names, joined by dashes, have this in them")
    parser.add_argument("--contact", choices=list(CONTACTS), default="closing")
    parser.add_argument("--angles", type=int, nargs="+", help="degrees, of rock")
    parser.add_argument("--densities", type=float, nargs="+")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    begun = time.time()
    for row in ROWS:
        if asked.only not in (name := named(row, asked)):
            continue
        kept = asked.out / f"{name}.npz"
        climbs = dict(np.load(kept)) if kept.exists() else None
        while (first := 0 if climbs is None else climbs["reason"].shape[-1]) < asked.grounds:
            more = climbed(row, range(first, min(first + asked.at_once, asked.grounds)), asked)
            climbs = more if climbs is None else {k: np.concatenate([climbs[k], more[k]], axis=-1) for k in KEPT}
            np.savez_compressed(kept, **climbs)
            shares = [f"{each['angle']}/{each['density']:g} {each['arrived']}" for each in table_of(row, climbs, asked)]
            print(
                f"{time.time() - begun:.0f} s: {name} of {climbs['reason'].shape[-1]}: {', '.join(shares)}", flush=True
            )
    files = {row: asked.out / f"{named(row, asked)}.npz" for row in ROWS}
    table = [each for row, kept in files.items() if kept.exists() for each in table_of(row, dict(np.load(kept)), asked)]
    with (asked.out / "climb.csv").open("w", newline="") as target:
        writer = csv.DictWriter(target, list(table[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
