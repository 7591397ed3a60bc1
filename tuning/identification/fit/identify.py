"""From a log to the parameters of a scenario: `identify`, and its result."""

import dataclasses
import math
import os
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.parameter_types import KEYS
from mjx_climb.physics.spatial import quaternion_to_matrix
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.fit import inference
from tuning.identification.fit.chain import Chain
from tuning.identification.fit.inference import Posterior, Whiteness
from tuning.identification.fit.iterates import Iterates, Progress
from tuning.identification.fit.least_squares import Fitted, LeastSquares, Problem, prior_of, scaled_residuals, search
from tuning.identification.fit.stamps import Noise, noise_of
from tuning.identification.model.gripped import cut_gripped, gripped_model
from tuning.identification.model.predicted import DELAY, PRESLIDING, SERVO_DELAY, Fit, model_of, with_nuisances
from tuning.identification.model.replay import Base, base_of
from tuning.identification.model.variables import Variable, applied, begin, in_units, variables
from tuning.identification.model.windows import KINDS, cut
from tuning.identification.readers import read_log
from tuning.identification.readers.doubts import several
from tuning.identification.readers.log import Log
from tuning.methods.parts import Parts, identity_of
from tuning.problem.evaluation import Problem as Walks

if TYPE_CHECKING:
    pass

HELD_OUT = 0.2
STARTS = 4
_SCREENED = 6  # windows on which the starts are compared
_SCREENING, _MOST, _PASSES = 10, 40, 4  # iterations, and passes with the noise estimated anew
_SETTLED = 0.05  # relative change of the noise
_UNHEARD = 30.0  # times their noise, where starts are compared
_GUESSED = "the log has base or foot forces: base free, all grippers shut (--base held: on a stand)"
_OTHERS = 4  # starts, where all those that were asked for diverge
_SPREAD = 0.7  # sd of the starts, of the prior's
_SHOWN = 3.0  # sd, of a delay that is there
_THINNEST, _SMALL = 1e-4, 0.01  # of a value, an interval; of the prior's sd, a value that is next to nothing


@dataclasses.dataclass(frozen=True)
class Estimate:
    """What is known of one key, SI units."""

    value: float  # where the search ended
    low: float | None  # 95 % interval; None: the fit is none that gives one
    high: float | None
    seen: bool  # the log told it
    before: float
    unit: str
    remark: str = ""  # bound or prior reached


@dataclasses.dataclass(frozen=True)
class Identified:
    """The result of `identify`."""

    scenario: mc.Scenario
    log: Log
    estimates: Mapping[str, Estimate]  # by key
    beside: Mapping[str, Estimate]  # nuisances: delays of what was recorded, presliding
    held_out: Mapping[str, Any]
    warnings: tuple[str, ...]
    combined: tuple[str, ...]  # combinations that were seen, of what was not
    model: Fit
    problem: LeastSquares
    fitted: Fitted
    posterior: Posterior
    tests: Sequence[Whiteness]

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        seen = sum(each.seen for each in self.estimates.values())
        held = self.held_out.get("error_over_noise")
        predicted = "" if held is None else f", and predicts what it has not seen within {held:.3g} of the noise"
        return f"{self.log.source} tells {seen} of {len(self.estimates)} parameters{predicted}"

    def as_json(self) -> dict[str, Any]:
        """Return what `mjx-climb identify --json` prints."""
        names = ("value", "low", "high", "seen")
        shown = {key: {n: getattr(each, n) for n in names} for key, each in self.estimates.items()}
        return {"parameters": shown, "held_out": dict(self.held_out), "warnings": list(self.warnings)}

    @property
    def known(self) -> dict[str, Estimate]:
        """The estimates that have an interval, by key: the others are as they were."""
        return {key: each for key, each in self.estimates.items() if each.low is not None}

    def overrides(self) -> dict[str, Any]:
        """Return the keys of a scenario with their new values; those of the robot go by its file."""
        found: dict[str, Any] = {k: each.value for k, each in self.known.items() if k in set(KEYS.values())}
        found = {key: max(value, 0.0) if key.endswith("delay") else value for key, value in found.items()}
        if (bend := self.beside.get(PRESLIDING)) is not None and bend.seen:  # the friction that was found goes with it
            found[PRESLIDING] = bend.value
        tilt = [self.known.get(f"gravity.tilt_{axis}") for axis in "xy"]
        if any(tilt):
            angles = [0.0 if each is None else each.value for each in tilt]
            found["gravity"] = (turned(angles) @ np.asarray(self.scenario.gravity)).tolist()
        return found

    def robot(self) -> Robot:
        """Return the robot with what was identified of it, constants of NumPy."""
        places, nominal = self.model.structure.places, load_robot(self.scenario.robot)
        before, known = begin(self.model.variables), self.known
        x = np.where([v.key in known for v in self.model.variables], self.fitted.x, before)
        with jax.enable_x64(True):
            _, robot = applied(places, jnp.asarray(x), self.model.parameters, nominal)
        constants: Robot = jax.tree.map(np.asarray, robot)
        return constants


def turned(angles: Sequence[float]) -> np.ndarray:
    """Return the rotation (3, 3) by angles about the world's x and y, rad."""
    vector = np.array([*angles, 0.0])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle else np.array([1.0, 0.0, 0.0])
    quaternion = np.r_[np.cos(angle / 2), np.sin(angle / 2) * axis]
    return np.asarray(quaternion_to_matrix(quaternion))


def identify(
    scenario: mc.Scenario,
    log: Log | str | os.PathLike[str],
    fit: Sequence[str],
    *,
    base: Base | None = None,
    signals: Any = None,
    changes: Mapping[str, Mapping[str, Any]] | None = None,
    mass: float = 0.0,
    held_out: float = HELD_OUT,
    starts: int = STARTS,
    progress: Progress | None = None,
    out: str | os.PathLike[str] | None = None,
) -> Identified:
    """Fit parameters of a scenario to what a robot recorded with its base held, or free on all shut grippers.

    Arguments:
        scenario: nominal values, robot and time step.
        log: as `tuning.identification.readers.read_log` gives it, or its file.
        fit: keys, or patterns of keys, as `hardware.servo.*`; see `tuning.identification.model.variables`.
        base: held or free; None: held where the log has neither base nor foot forces.
        signals: of a file, where each signal stands in it.
        changes: by key, fields of `tuning.identification.model.variables.Variable` in place of its own, as
            `{"control.kp": {"frozen": True}}`.
        mass: that hung on each foot while the log was made, kg; it is no part of what is identified.
        held_out: share of the log, at its end, that is predicted and not fitted.
        starts: points from which the search begins, the nominal one among them.
        progress: called with iterations done, at most to do, and a line.
        out: a folder in which every iteration is kept: what was interrupted goes on there, with the same arguments.

    Raises:
        ConfigError: no such key, or a log that holds nothing to fit.
        OutputError: `out` cannot be written to, or holds an unfinished computation of other arguments.
    """
    robot = load_robot(scenario.robot)
    log = log if isinstance(log, Log) else read_log(log, robot, signals)
    chosen_base = base_of(log, base, mass)
    chosen = variables(scenario, fit, held=chosen_base == "held", changes=changes)
    if chosen_base == "held":
        problem = _held(scenario, log, robot, chosen, held_out, mass)
    else:
        problem = _gripped(scenario, log, robot, chosen, held_out)
    model = problem.model
    with Parts(out, lambda: identity_of_fit(scenario, log, model, held_out, starts) | {"base": chosen_base}) as parts:
        found, problem = _searched(problem, starts, Iterates(parts, progress))
    guessed = [_GUESSED] if base is None and chosen_base == "free" else []
    return _identified(scenario, log, chosen, (found, problem), [*log.warnings, *guessed])


def _identified(
    scenario: mc.Scenario, log: Log, chosen: Sequence[Variable], fit: tuple[Fitted, LeastSquares], warnings: list[str]
) -> Identified:
    """Return the result, with what is to be said of the fit behind the warnings so far."""
    found, problem = fit
    tests = inference.whiteness(problem, found)
    wrong = inference.suspicious(tests)
    known = inference.posterior(problem, found, tests, wrong)
    model, beside, ahead = problem.model, _estimates(problem.model, found, known), _predicted(problem, found)
    useless = inference.useless(found.noise, _moved(model), ahead.get("error_over_noise"))
    blind = known.blind(model.variables)
    beside = {
        v.key: beside[v.key] if nothing else trusted(beside[v.key], v, refuted=bool(wrong), useless=bool(useless))
        for v, nothing in zip(model.variables, blind, strict=True)
    }
    estimates = {v.key: beside.pop(v.key) for v in chosen}
    unseen = [line for line in known.unseen if any(v.key in line for v in chosen)]
    remarks = [f"{key}: {each.remark}" for key, each in estimates.items() if each.remark]
    bounds = [f"{key}: {each.remark}" for key, each in beside.items() if " bound" in each.remark]
    said = [*_of_windows(model), *_of_schedule(model, estimates), *unseen, *remarks, *bounds]
    said += _of_log_step(model, found, beside)
    said += [*_of_fit(found, wrong, len(tests), {} if useless else ahead), *([useless] if useless else [])]
    combined = () if useless else known.combined
    return Identified(
        scenario, log, estimates, beside, ahead, (*warnings, *said), combined, model, problem, found, known, tests
    )


def trusted(estimate: Estimate, variable: Variable, *, refuted: bool, useless: bool) -> Estimate:
    """Return an estimate, without its interval where that says nothing: of a fit that is useless, or of no width."""
    if estimate.low is None or estimate.high is None:
        return estimate
    size = max(abs(estimate.value), abs(estimate.before), 0.0 if variable.log else _SMALL * variable.sd)
    width = estimate.high - estimate.low
    thin = width == 0 or (refuted and width < _THINNEST * size)
    if not (thin or useless):
        return estimate
    why = "no interval: it would be thinner than a ten-thousandth of the value, on a model that the residuals refute"
    remark = "; ".join(filter(None, [estimate.remark, why if thin and not useless else ""]))
    return dataclasses.replace(estimate, low=None, high=None, seen=False, remark=remark)


def identity_of_fit(scenario: mc.Scenario, log: Log, model: Fit, held_out: float, starts: int) -> dict[str, Any]:
    """Return all that determines a fit, as plain JSON values."""
    fitted = [{name: str(value) for name, value in dataclasses.asdict(each).items()} for each in model.variables]
    more = {"log": log.digest, "fit": fitted, "mass": model.structure.mass, "held_out": held_out, "starts": starts}
    return {**identity_of(Walks(scenario)), **more}


def _of_windows(model: Fit) -> Iterator[str]:
    """Yield what of a log is not fitted."""
    windows = model.windows
    if count := len(windows.unknown):
        seconds = float(np.diff(windows.unknown).sum())
        yield (
            f"commands are missing in {count} holes, {seconds:.3g} s in all: what happens in one is not fitted, and "
            "what follows begins anew"
        )
    if windows.constant:
        yield f"{several(windows.constant)}: the same all the time, not fitted"


def _of_log_step(model: Fit, found: Fitted, beside: Mapping[str, Estimate]) -> Iterator[str]:
    """Yield what a simulator's time step may have made of the values, where velocities come late as its would.

    One of first order has velocities of half a step before its angles: what damps a joint then acts as late.
    """
    late = beside.get("log.velocity.delay")
    if late is None or late.low is None or late.high is None or not late.seen:
        return
    sd = (late.high - late.low) / 2 / inference.Z
    if abs(late.value) < _SHOWN * sd or abs(late.value) < model.windows.time_step / 2:
        return
    own = dict(zip((v.key for v in model.variables), found.x.tolist(), strict=True))
    kd, viscous = (
        float(own.get(key, np.asarray(getattr(model.parameters, field))))
        for key, field in (("control.kd", "kd"), ("hardware.servo.viscous_friction", "viscous_friction"))
    )
    size = abs(late.value)
    doubts = {DELAY: f"{size:.2g} s", "hardware.servo.armature": f"{(kd + viscous) * size:.2g} kg m^2"}
    named = [f"{key} by {doubt}" for key, doubt in doubts.items() if key in own]
    yield (
        f"velocities come {1e3 * late.value:.3g} ms after positions, as those of a simulator with steps of "
        f"{2e3 * size:.3g} ms do: if one made this log, its step is a doubt beside the intervals"
        + (f" ({', '.join(named)})" if named else "")
    )


def _of_schedule(model: Fit, chosen: Collection[str]) -> Iterator[str]:
    """Yield what is to be said of P gains by time and of torque off."""
    if (schedule := model.schedule) is None:
        return
    kp = float(np.asarray(model.parameters.kp))
    if not schedule.share.any():
        what = "control.kp is 0" if schedule.on.any() else "the torque is off"
        yield f"{what} all the while in the log, which tells nothing of the P gain and of commands"
        return
    if "control.kp" in chosen and not (schedule.share == 1).any():
        yield (
            f"control.kp stands for what the log calls {kp:g} N m/rad, as the config has it; the log's own gains are "
            "in proportion"
        )
    off, windows = schedule.time[schedule.on == 0], model.windows
    if len(off) and windows.held_out.any() and off[0] >= windows.begin[windows.held_out][0]:
        yield "the torque is off in what is held out alone, and tells nothing (--held-out 0 fits it)"


def _held(
    scenario: mc.Scenario, log: Log, robot: Robot, chosen: Sequence[Variable], held_out: float, mass: float
) -> LeastSquares:
    windows = cut(log, robot, scenario.time_step, held_out, late=_latest(scenario, chosen))
    model = model_of(scenario, windows, with_nuisances(scenario, windows, chosen), mass)
    return Problem(model, np.arange(len(windows.begin)), _rough_noise(model))


def _latest(scenario: mc.Scenario, chosen: Sequence[Variable]) -> float:
    """Return the longest time that commands may take to the motors, s."""
    fitted, own = {v.key: v.upper for v in chosen}, scenario.hardware
    nominal = {DELAY: own.command_delay, SERVO_DELAY: own.servo.delay}
    return sum(fitted.get(key, delay) for key, delay in nominal.items())


def _gripped(
    scenario: mc.Scenario, log: Log, robot: Robot, chosen: Sequence[Variable], held_out: float
) -> LeastSquares:
    windows = cut_gripped(log, robot, scenario.time_step, held_out)
    model = gripped_model(scenario, log, windows, chosen)
    return Chain(model, np.arange(len(windows.begin)), _rough_noise(model))


def _of_fit(found: Fitted, wrong: Sequence[Whiteness], signals: int, ahead: Mapping[str, Any]) -> list[str]:
    """Return what is to be said of a fit as a whole."""
    said = []
    if found.clock:
        said.append(
            f"time stamps err by {found.clock:.2g} s (standard deviation), what was sampled at once together; this is "
            "counted as noise"
        )
    if wrong:
        said.append(f"{wrong[0].in_words} ({len(wrong)} of {signals} signals; intervals are widened)")
    if not found.converged:
        said.append("the search ended at its last iteration, not at a minimum")
    if ahead and ahead["error_over_noise"] > 1.2:
        said.append(f"what was held out is predicted {ahead['error_over_noise']:.3g} times worse than the noise")
    return said


def _searched(problem: LeastSquares, starts: int, kept: Iterates) -> tuple[Fitted, LeastSquares]:
    model, noise = problem.model, problem.noise
    windows, prior = model.windows, prior_of(model)
    rng = np.random.default_rng(0)
    points = prior.mean + _SPREAD * prior.sd * rng.standard_normal((max(starts, 1) + _OTHERS, len(prior.mean)))
    points = np.clip(np.where(points < prior.lower, 2 * prior.lower - points, points), prior.lower, prior.upper)
    # where a command comes as a sample is taken, a later one changes nothing of it: no place to begin
    off = [2 * windows.time_step if v.key == DELAY else -np.inf for v in model.variables]
    points[0] = np.maximum(begin(model.variables), off)
    # torques jump as commands do: no slope leads from one side of a jump to the other
    louder = np.where(windows.kind == KINDS.index("effort"), _UNHEARD * noise, noise)
    trial = dataclasses.replace(problem, which=problem.some(_SCREENED), noise=louder)
    points, others = points[:-_OTHERS], points[-_OTHERS:]
    # where all diverge, as a limb without armature that falls, others begin
    for name, own in (("starts", points), ("other starts", others)):
        guesses = np.repeat(trial.guess[None], len(own), axis=0)
        screened = search(trial, own, guesses, _SCREENING, name, kept)
        best = min(screened, key=lambda each: each.cost)
        if np.isfinite(best.cost):
            break
    x, start = best.x[None], problem.guess[None]
    for n in range(_PASSES):
        (found,) = search(problem, x, start, _MOST, f"pass {n + 1}", kept)
        which, before = (problem.rows.signal, problem.rows.stamp), Noise(problem.noise, problem.clock)
        now = noise_of(found.normal.residuals, found.normal.stamps, problem.fitted, which, before)
        x, start = found.x[None], found.start[None]
        settled = np.abs(np.log(now.signals / problem.noise)).max() < _SETTLED
        if settled and abs(now.clock - problem.clock) <= _SETTLED * now.clock:
            break
        problem = dataclasses.replace(problem, noise=now.signals, clock=now.clock)
    if not np.isfinite(found.cost):
        raise ConfigError("the model diverges at the values that it begins with (--set others)")
    return found, problem


def _moved(model: Fit) -> np.ndarray:
    """Return the standard deviation of each signal (signals,), SI units."""
    rows = model.windows.rows
    return np.array([np.std(rows.value[rows.signal == n]) for n in range(len(model.windows.names))])


def _rough_noise(model: Fit) -> np.ndarray:
    """Return noise (signals,) from second differences, which hold some motion too."""
    rows, noise = model.windows.rows, np.ones(len(model.windows.names))
    for signal in range(len(noise)):
        value = rows.value[rows.signal == signal]
        bend = np.abs(np.diff(value, 2)) if len(value) > 10 else np.array([np.ptp(value)])
        noise[signal] = max(1.4826 * float(np.median(bend)) / np.sqrt(6), 1e-3 * float(np.ptp(value)), 1e-9)
    return noise


def _estimates(model: Fit, found: Fitted, known: Posterior) -> dict[str, Estimate]:
    robot = load_robot(model.structure.robot)
    with jax.enable_x64(True):
        values = np.asarray(in_units(model.variables, jnp.asarray(found.x), robot))
        slope = np.asarray(jax.jacfwd(lambda x: in_units(model.variables, x, robot))(jnp.asarray(found.x)))
    sd, sd_units = (
        np.sqrt(np.maximum(np.diag(c), 0.0)) for c in (known.covariance, slope @ known.covariance @ slope.T)
    )
    estimates = {}
    for n, v in enumerate(model.variables):
        low, high = inference.interval(v, found.x[n], sd[n])
        if ".inertia." in v.key:
            low, high = (float(values[n] + side * inference.Z * sd_units[n]) for side in (-1, 1))
        estimates[v.key] = Estimate(
            float(values[n]), low, high, bool(known.seen[n]), v.nominal, v.unit, _remark(v, found.x[n])
        )
    return estimates


def _remark(variable: Variable, x: float) -> str:
    low, high = variable.bounds
    for name, bound in (("lower", low), ("upper", high)):
        if np.isfinite(bound) and abs(x - bound) < 1e-9 + 1e-6 * abs(bound):
            return f"on its {name} bound, {(math.exp(bound) if variable.log else bound):.3g} {variable.unit}"
    off = abs(x - variable.mean) / variable.sd
    return f"{off:.1f} sd off its prior" if off > 3 else ""


def _predicted(problem: LeastSquares, found: Fitted) -> dict[str, Any]:
    """Return how what was held out is predicted: errors (rms) over the noise, of all and of each signal."""
    held = problem.predicted
    if not held.any():
        return {}
    scaled = scaled_residuals(problem, found.normal)
    by_signal = {
        name: float(np.sqrt((scaled[held & (problem.rows.signal == n)] ** 2).mean()))
        for n, name in enumerate(problem.model.windows.names)
        if (held & (problem.rows.signal == n)).any()
    }
    seconds = float(
        problem.model.windows.held_out.sum() * problem.model.windows.steps * problem.model.windows.time_step
    )
    return {"error_over_noise": float(np.sqrt((scaled[held] ** 2).mean())), "seconds": seconds, "signals": by_signal}
