"""What a fit says: estimates with their intervals, how it predicts what was held out, and warnings."""

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from mjx_climb.robot_import.load import load_robot
from tuning.identification.fit import inference
from tuning.identification.fit.inference import Posterior, Whiteness
from tuning.identification.fit.least_squares import Fitted, LeastSquares, scaled_residuals
from tuning.identification.fit.result import Estimate, Identified
from tuning.identification.model.predicted import DELAY, Fit
from tuning.identification.model.variables import Variable, in_units
from tuning.identification.readers.doubts import several
from tuning.identification.readers.log import Log

SETTLED = 0.05  # relative change of the noise
_SHOWN = 3.0  # sd, of a delay that is there
_THINNEST, _SMALL = 1e-4, 0.01  # of a value, an interval; of the prior's sd, a value that is next to nothing


def identified(
    scenario: mc.Scenario,
    log: Log,
    chosen: Sequence[Variable],
    fit: tuple[Fitted, LeastSquares, Sequence[Whiteness]],
    warnings: Sequence[str],
    hint: str,
) -> Identified:
    """Return the result, with what is to be said of the fit behind the warnings so far.

    Arguments:
        scenario: with the nominal values.
        log: that was fitted.
        chosen: what was asked for.
        fit: where the search ended, what was fitted, and the tests of its residuals.
        warnings: so far.
        hint: which change of the profile explains the residuals, "" for none.
    """
    found, problem, tests = fit
    wrong = inference.suspicious(tests)
    known = inference.posterior(problem, found, tests)
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
    said += [
        *_of_fit(found, model.variables, wrong, len(tests), {} if useless else ahead),
        *filter(None, [hint, useless]),
    ]
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
    if name := variable.bound_at(x):
        return f"on its {name} bound, {getattr(variable, name):.3g} {variable.unit}"
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


def _moved(model: Fit) -> np.ndarray:
    """Return the standard deviation of each signal (signals,), SI units."""
    rows = model.windows.rows
    return np.array([np.std(rows.value[rows.signal == n]) for n in range(len(model.windows.names))])


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


def _of_schedule(model: Fit, chosen: Collection[str]) -> Iterator[str]:
    """Yield what is to be said of P gains by time and of torque off."""
    if (schedule := model.schedule) is None:
        return
    kp = float(np.asarray(model.parameters.joint_loop.kp))
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
    values = {**model.parameters.values, **own}
    kd, viscous = (float(np.asarray(values.get(key, 0.0))) for key in ("control.kd", "hardware.servo.viscous_friction"))
    size = abs(late.value)
    doubts = {DELAY: f"{size:.2g} s", "hardware.servo.armature": f"{(kd + viscous) * size:.2g} kg m^2"}
    named = [f"{key} by {doubt}" for key, doubt in doubts.items() if key in own]
    yield (
        f"velocities come {1e3 * late.value:.3g} ms after positions, as those of a simulator with steps of "
        f"{2e3 * size:.3g} ms do: if one made this log, its step is a doubt beside the intervals"
        + (f" ({', '.join(named)})" if named else "")
    )


def _of_fit(
    found: Fitted, variables: Sequence[Variable], wrong: Sequence[Whiteness], signals: int, ahead: Mapping[str, Any]
) -> list[str]:
    """Return the remarks on a fit as a whole."""
    said = []
    if found.clock:
        said.append(
            f"time stamps err by {found.clock:.2g} s (standard deviation), what was sampled at once together; this is "
            "counted as noise"
        )
    if wrong:
        said.append(f"{wrong[0].in_words} ({len(wrong)} of {signals} signals; intervals are widened)")
    if found.ended != "converged":
        away, key = max((a, v.key) for a, v in zip(found.away.tolist(), variables, strict=True) if not v.beside)
        why = "is stuck where no step makes it better" if found.ended == "stuck" else "ended at its last iteration"
        said.append(f"the search {why}: by its derivatives {key} is {away:.2g} standard deviations from the minimum")
    if found.unsettled >= SETTLED:
        said.append(
            f"the noise did not settle: estimated once more it would change by "
            f"{100 * found.unsettled:.0f} %, and the intervals with it"
        )
    if ahead and ahead["error_over_noise"] > 1.2:
        said.append(f"what was held out is predicted {ahead['error_over_noise']:.3g} times worse than the noise")
    return said
