"""What recordings of real servos tell: from random starts, from disjoint parts, and of recordings that were not fitted.

    python docs/studies/recordings.py FOLDER results/recordings.csv [--workers 16] [--starts 10]

FOLDER has the CSV files of BAM's pendulums (github.com/Rhoban/bam, Apache-2.0, commits af22604 and b53408c) with the
columns time, goal_position, position, torque_enable, by the names xl330_p100_sin_sin.csv. A row is one parameter of one
fit; rows of the key `error` have the mean absolute error, in degrees, of a recording while the motor is on. Costs count
in the noise that each fit estimates for itself: of the same recordings the degrees missed are compared.
"""

import argparse
import csv
import functools
import itertools
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pool import table

MOTIONS = ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square")
XL330 = tuple(f"xl330_p{p}_{motion}" for p in (100, 200, 400) for motion in MOTIONS)
STS3250 = tuple(f"sts3250_p32_{motion}" for motion in MOTIONS if motion != "lift_and_drop")
PENDULUMS = {"xl330": (0.49, 0.1), "sts3250": (1.13, 0.12)}  # kg, m
SERVO = {
    "xl330": {
        "hardware.servo.registers": {"p": 400}, "hardware.servo.supply_voltage": 7.4,
        "hardware.servo.supply_resistance": 0.2,
    },
    # where the search begins: the motor of the data sheet, the rest by guess
    "sts3250": {"control.kp": 50.0, "control.kd": 1.0, **{f"hardware.servo.{key}": value for key, value in {
        "torque_limit": 4.903, "no_load_speed": 7.87, "armature": 0.005, "coulomb_friction": 0.1,
        "external_load_friction": 0.1}.items()}},
}  # fmt: skip
KEYS = {
    "xl330": [f"hardware.servo.{key}" for key in (
        "armature", "torque_limit", "no_load_speed", "coulomb_friction", "viscous_friction", "load_friction",
        "external_load_friction", "supply_resistance")],
    "sts3250": ["control.kp", "control.kd", "hardware.command_delay", *(f"hardware.servo.{key}" for key in (
        "armature", "torque_limit", "no_load_speed", "coulomb_friction", "external_load_friction"))],
}  # fmt: skip
COLUMNS = ("question", "fit", "key", "value", "low", "high", "cost", "ended", "cpu")


class Job(NamedTuple):
    """One fit."""

    question: str  # starts, parts, or prediction
    name: str
    fitted: tuple[str, ...]
    predicted: tuple[str, ...] = ()
    start: int = 0  # 0: the profile's values


def log_of(folder: Path, names: tuple[str, ...], kp: float) -> Any:
    """The log of recordings a second apart; `kp` is that of a P register of 400."""
    from tuning.identification.readers.log import Log, Signal

    parts, begin = [], 0.0
    for name in names:
        with (folder / f"{name}.csv").open() as file:
            rows = list(csv.DictReader(file))
        t, goal, angle, on = (
            np.array([float(row[column]) for row in rows])
            for column in ("time", "goal_position", "position", "torque_enable")
        )
        share = float(name.split("_")[1][1:]) / 400 if name.startswith("xl330") else 1.0
        parts.append(np.stack([begin + t - t[0], goal, angle, np.full(len(t), share * kp), 1 - on]))
        begin = parts[-1][0, -1] + 1.0
    t, *columns = np.concatenate(parts, axis=1)
    signals = ("rod.swing.command", "rod.swing.position", "control.kp", "torque_off")
    return Log({name: Signal(t, column) for name, column in zip(signals, columns, strict=True)}, "bench.csv")


def bench(kind: str, folder: str) -> Any:
    """The scenario of a pendulum on a servo."""
    import mjx_climb as mc
    from mjx_climb.scenario.load import load_hardware, with_hardware

    mass, length = PENDULUMS[kind]
    file = Path(folder) / "pendulum.xml"
    file.write_text(
        f'<mujoco><worldbody><body name="rod"><joint name="swing" axis="0 -1 0" range="-3.5 3.5" limited="true"/>'
        f'<inertial pos="0 0 {-length}" mass="{mass}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>'
    )
    robot = {"file": str(file), "limbs": {"rod": {"joints": ["swing"]}}}
    scenario = mc.Scenario().with_overrides({"robot": robot, "gravity": [0.0, 0.0, -9.80665]})
    profile = {"xl330": "xl_330", "sts3250": "sts3250"}[kind]
    return with_hardware(scenario, load_hardware(profile)).with_overrides(SERVO[kind])


def rows_of(job: Job, recordings: str) -> list[tuple[Any, ...]]:
    """The rows of one fit."""
    import tuning
    from tuning.identification.model import replay
    from tuning.identification.model.variables import variables

    begun, kind, folder = time.process_time(), job.fitted[0].partition("_")[0], Path(recordings)
    with tempfile.TemporaryDirectory() as made:
        scenario = bench(kind, made)
        changes = {}
        if job.start:  # another value to begin at, under the same prior
            rng = np.random.default_rng(job.start)
            for v in variables(scenario, KEYS[kind], held=True):
                size = v.sd if v.log or not v.nominal else min(v.sd, abs(v.nominal))
                x = v.mean + 0.7 * size * rng.standard_normal()
                changes[v.key] = {"nominal": float(np.exp(x) if v.log else abs(x))}
        log = log_of(folder, job.fitted, scenario.control.kp)
        found = tuning.identify(scenario, log, KEYS[kind], held_out=0.0, starts=1, changes=changes)
        own = (job.question, job.name)
        end = (found.fitted.cost, found.fitted.ended, time.process_time() - begun)
        rows = [(*own, key, each.value, each.low, each.high, *end) for key, each in found.estimates.items()]
        missed = float(np.degrees(np.sqrt(np.mean(found.fitted.residuals**2))))
        more = {"cost of the start": found.fitted.costs[0], "lowest cost of pieces": min(found.fitted.costs),
                "missed, degrees rms": missed}  # fmt: skip
        rows += [(*own, name, value, "", "", *end) for name, value in more.items()]
        for name in job.predicted:
            one = log_of(folder, (name,), scenario.control.kp)
            walk = replay.simulate(replay.prepare(one, scenario.with_overrides(found.overrides()), "held", 0.0)).walk
            angle, on = one.signals["rod.swing.position"], one.signals["torque_off"].value < 0.5
            model = np.interp(angle.time, walk.time, walk.joint_angles[:, 0, 0])
            error = float(np.degrees(np.abs(angle.value - model)[on].mean()))
            rows.append((*own, f"error of {name}", error, "", "", *end))
        return rows


def jobs(starts: int) -> list[Job]:
    """All fits."""
    found = [Job("starts", f"start {n}", XL330, start=n) for n in range(starts)]
    for part in range(4):
        own = tuple(f"xl330_p{p}_{MOTIONS[(n + part) % 4]}" for n, p in enumerate((100, 200, 400)))
        found.append(Job("parts", f"part {part + 1}", own))
    weak, strong = XL330[:8], XL330[8:]
    found.append(Job("prediction", "P 100 and 200", weak, strong))
    found.append(Job("prediction", "all of the XL330", XL330, XL330))
    found += [Job("prediction", f"all but {one}", tuple(n for n in STS3250 if n != one), (one,)) for one in STS3250]
    return [*found, Job("prediction", "all of the STS3250", STS3250, STS3250)]


def overlap(rows: list[tuple[Any, ...]]) -> str:
    """How many intervals of pairs of parts overlap, in words."""
    ends = {(row[1], row[2]): row[4:6] for row in rows if row[0] == "parts" and row[4] != ""}
    pairs = [
        ends[a, key][0] <= ends[b, key][1] and ends[b, key][0] <= ends[a, key][1]
        for key in KEYS["xl330"]
        for a, b in itertools.combinations(sorted({name for name, _ in ends}), 2)
    ]
    return f"intervals of disjoint parts overlap in {sum(pairs)} of {len(pairs)} pairs"


def main() -> None:
    """Fit, and write the table."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("folder")
    asked.add_argument("out")
    asked.add_argument("--workers", type=int, default=2)
    asked.add_argument("--starts", type=int, default=10)
    options = asked.parse_args()
    of_folder = functools.partial(rows_of, recordings=options.folder)
    rows = table(options.out, COLUMNS, of_folder, jobs(options.starts), options.workers)
    print(overlap(rows))


if __name__ == "__main__":
    main()
