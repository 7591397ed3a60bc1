"""How often intervals of `mjx-climb identify` hold the truth, on benches inside the model and outside of it.

    python docs/studies/identification.py results/coverage.csv [--workers 16] [--inside N] [--outside N] [--short N]
        [--time-step 0.001]

Each log is one of a pendulum on a servo, integrated by the equations of `Bench` at 0.02 ms, 200 Hz, with noise of a
milliradian; `--time-step` is the fit's. `short` logs have 2 to 10 s, inside the model and outside of it by turns, all
others 6 s. A row is an interval of one parameter of one log; logs of all kinds come by turns. At the end the shares are
printed with their exact binomial intervals, and those by parameter as a table.
"""

import argparse
import math
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from pool import table
from scipy.stats import binomtest

STEP, RATE, NOISE = 2e-5, 200.0, 1e-3  # s, Hz, rad
MASS, LENGTH, GRAVITY, STALL, FASTEST = 0.49, 0.1, 9.81, 1.2, 20.0  # kg, m, m/s^2, N m, rad/s
SPANS = {  # even in the logarithm
    "hardware.servo.armature": (0.001, 0.006), "hardware.servo.coulomb_friction": (0.01, 0.06),
    "hardware.servo.viscous_friction": (0.005, 0.03), "control.kp": (2.0, 6.0), "hardware.command_delay": (0.002, 0.01),
}  # fmt: skip
NOMINAL = {
    "hardware.servo.armature": 0.003, "hardware.servo.coulomb_friction": 0.03, "hardware.servo.viscous_friction": 0.01,
    "control.kp": 3.5, "hardware.command_delay": 0.005,
}  # fmt: skip
OUTSIDE = {  # what moves beside the model, by kind: spans of its size
    "stribeck": (0.3, 1.0),  # of the dry friction, more at rest, gone at 0.3 rad/s
    "cogging": (0.01, 0.05),  # N m, 24 times a turn
    "backlash": (0.01, 0.04),  # rad
    "flexible joint": (5.0, 30.0),  # N m/rad between gear and rod
    "sagging supply": (0.2, 0.6),  # resistance of the supply over that of the motor
}
COLUMNS = ("kind", "log", "seconds", "size", "key", "truth", "value", "low", "high", "inside", "wrong", "ahead", "cpu")


class Job(NamedTuple):
    """One log."""

    kind: str  # inside, or of OUTSIDE
    group: str  # inside, outside, short
    number: int
    seconds: float
    time_step: float  # s, of the fit


class Bench(NamedTuple):
    """A pendulum on a servo, and what moves it beside the model."""

    armature: float
    coulomb: float
    viscous: float
    kp: float
    delay: float
    stribeck: float = 0.0
    cogging: float = 0.0
    backlash: float = 0.0
    stiffness: float = 0.0
    sag: float = 0.0


def goals(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """Goals (T,) rad without jumps: whole turns of a chirp, then slow ramps."""
    t, half = np.arange(round(seconds * RATE)) / RATE, seconds / 2
    faster = (round(1.3 * half) - 0.4 * half) / half**2
    chirp = 0.8 * np.sin(2 * np.pi * (0.4 * t + faster * t**2))
    ramp = 0.6 * np.abs((3 * (t - half) / half + 3) % 4 - 2) - 0.6
    return np.asarray(np.where(t < half, chirp, ramp) * rng.uniform(0.7, 1.2))


def swung(bench: Bench, sent: np.ndarray) -> np.ndarray:
    """Angles (T,) rad of the motor's side, from rest at 0, by semi-implicit Euler's steps with sticking friction."""
    inertia, every = MASS * LENGTH**2, round(1 / RATE / STEP)
    rod, rod_rate, angle, rate, found = 0.0, 0.0, 0.0, 0.0, []
    late = round(bench.delay / STEP)
    for n in range(len(sent) * every):
        if n % every == 0:
            found.append(angle)
        error = sent[max(n - late, 0) // every] - angle
        error -= min(max(error, -bench.backlash / 2), bench.backlash / 2)
        share = min(max(bench.kp / STALL * error, -1.0), 1.0)
        volts = (1 + bench.sag * share * rate / FASTEST) / (1 + bench.sag * share**2)
        torque = STALL * share * volts - STALL / FASTEST * rate - bench.viscous * rate
        torque += bench.cogging * math.sin(24 * angle)
        weight = -MASS * GRAVITY * LENGTH * math.sin(rod if bench.stiffness else angle)
        if bench.stiffness:
            spring = bench.stiffness * (rod - angle) + 0.003 * (rod_rate - rate)
            rod_rate += STEP * (weight - spring) / inertia
            rod += STEP * rod_rate
            moved = bench.armature
            rate += STEP * (torque + spring) / moved
        else:
            moved = inertia + bench.armature
            rate += STEP * (torque + weight) / moved
        rubs = bench.coulomb * (1 + bench.stribeck * math.exp(-abs(rate) / 0.1)) * STEP / moved
        rate = math.copysign(max(abs(rate) - rubs, 0.0), rate)
        angle += STEP * rate
    return np.array(found)


def drawn(job: Job) -> tuple[Bench, float, dict[str, float]]:
    """A bench, the size of its part outside of the model, and the truth by key."""
    rng = np.random.default_rng([job.number, len(job.group)])
    truth = {key: float(np.exp(rng.uniform(*np.log(span)))) for key, span in SPANS.items()}
    size = 0.0 if job.kind == "inside" else float(np.exp(rng.uniform(*np.log(OUTSIDE[job.kind]))))
    names = {"flexible joint": "stiffness", "sagging supply": "sag"}
    more = {} if job.kind == "inside" else {names.get(job.kind, job.kind): size}
    return Bench(*truth.values(), **more), size, truth


def rows_of(job: Job) -> list[tuple[Any, ...]]:
    """The rows of one log."""
    import mjx_climb as mc
    import tuning
    from tuning.identification.fit.inference import suspicious
    from tuning.identification.readers.log import Log, Signal

    begun = time.process_time()
    bench, size, truth = drawn(job)
    rng = np.random.default_rng([job.number, 77])
    sent = goals(job.seconds, rng)
    times = np.arange(len(sent)) / RATE
    angles = swung(bench, sent) + NOISE * rng.standard_normal(len(sent))
    log = Log({"rod.swing.command": Signal(times, sent), "rod.swing.position": Signal(times, angles)}, job.kind)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "pendulum.xml"
        file.write_text(
            f'<mujoco><worldbody><body name="rod"><joint name="swing" axis="0 -1 0" range="-3.5 3.5" limited="true"/>'
            f'<inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>'
        )
        robot = {"file": str(file), "limbs": {"rod": {"joints": ["swing"]}}}
        servo = {"drive": "voltage", "torque_limit": STALL, "no_load_speed": FASTEST}
        values = {
            "gravity": [0.0, 0.0, -GRAVITY],
            "control.kd": 0.0,
            "hardware.servo": servo,
            "time_step": job.time_step,
        }
        scenario = mc.Scenario().with_overrides({"robot": robot, **values}).with_overrides(NOMINAL)
        found = tuning.identify(scenario, log, list(SPANS), starts=1)
    wrong, ahead = bool(suspicious(found.tests)), found.held_out.get("error_over_noise", math.nan)
    cpu = time.process_time() - begun
    return [
        (f"{job.group}: {job.kind}" if job.group == "short" else job.kind, job.number, job.seconds, size, key,
         truth[key], each.value, each.low, each.high, int(each.low <= truth[key] <= each.high), int(wrong), ahead, cpu)
        for key, each in found.estimates.items()
    ]  # fmt: skip


def jobs(inside: int, outside: int, short: int, time_step: float) -> list[Job]:
    """All logs."""
    kinds = list(OUTSIDE)
    found = [Job("inside", "inside", n, 6.0, time_step) for n in range(inside)]
    found += [Job(kinds[n % len(kinds)], "outside", n, 6.0, time_step) for n in range(outside)]
    lengths = (2.0, 3.0, 5.0, 7.0, 10.0)
    of_short = ("inside", kinds[0], "inside", kinds[2], "inside", kinds[3], "inside", kinds[4])
    found += [Job(of_short[n % 8], "short", n, lengths[n % 5], time_step) for n in range(short)]
    counts = {"inside": inside, "outside": outside, "short": short}
    return sorted(found, key=lambda job: (job.number + 0.5) / counts[job.group])


def share(name: str, held: np.ndarray) -> str:
    """The share of some that hold, in words."""
    low, high = binomtest(int(held.sum()), held.size).proportion_ci()
    return f"{name}: {held.sum()} of {held.size}, {held.mean():.1%} ({low:.1%} to {high:.1%})"


def print_shares(rows: list[tuple[Any, ...]], time_step: float) -> None:
    """Print how often intervals hold the truth, and how often they or "the model is wrong" do, in two tables."""
    found = [(row[0], row[4], bool(int(row[9])), bool(int(row[9]) or int(row[10]))) for row in rows]
    for kind in sorted({each[0] for each in found}):
        inside, either = (np.array([each[n] for each in found if each[0] == kind]) for n in (2, 3))
        print(share(f"{kind}, inside", inside), share("inside or wrong", either), sep="; ")
    print('logs,"step of the fit, s",parameter,count,"inside, %","inside or wrong, %"')
    for kind, key in sorted({each[:2] for each in found}):
        own = np.array([each[2:] for each in found if each[:2] == (kind, key)])
        print(kind, time_step, key, len(own), *(f"{100 * each:.1f}" for each in own.mean(axis=0)), sep=",")


def main() -> None:
    """Count, and write the table."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("out")
    for name, default in (("workers", 2), ("inside", 100), ("outside", 100), ("short", 40)):
        asked.add_argument(f"--{name}", type=int, default=default)
    asked.add_argument("--time-step", type=float, default=0.001)
    options = asked.parse_args()
    counts = (options.inside, options.outside, options.short, options.time_step)
    rows = table(options.out, COLUMNS, rows_of, jobs(*counts), options.workers)
    print_shares(rows, options.time_step)


if __name__ == "__main__":
    main()
