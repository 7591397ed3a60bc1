"""The findings of a fit: estimates with their intervals, the error of the held-out part, warnings."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mjx_climb as mc
from tuning.identification.fit import inference
from tuning.identification.fit.inference import Posterior, Whiteness
from tuning.identification.fit.problem import Fitted, Problem
from tuning.identification.fit.result import Estimate, Identified
from tuning.identification.model.predicted import DELAY, Fit
from tuning.identification.model.variables import Variable, in_units
from tuning.identification.readers.doubts import several
from tuning.identification.readers.log import Log

SETTLED = 0.05  # relative change of the noise
_SHOWN = 3.0  # sd, of a delay that is there
_ONE = 0.01  # relative difference of the costs of one optimum


def identified(
    scenario: mc.Scenario,
    log: Log,
    chosen: Sequence[Variable],
    fit: tuple[Fitted, Problem, Sequence[Whiteness]],
    warnings: Sequence[str],
    hint: str,
) -> Identified:
    """The result, with the remarks on the fit behind the warnings so far.

    Arguments:
        scenario: with the nominal values.
        log: that was fitted.
        chosen: the variables that were asked for.
        fit: the end of the search, its problem, and the tests of its residuals.
        warnings: so far.
        hint: which change of the profile explains the residuals, "" for none.
    """
    found, problem, tests = fit
    wrong = inference.suspicious(tests)
    model, ahead = problem.model, _predicted(problem, found)
    known = inference.posterior(problem, found, tests, ahead.get("error_over_noise", 1.0))
    beside = _estimates(problem, found, known)
    estimates = {v.key: beside.pop(v.key) for v in chosen}
    unseen = [line for line in known.unseen if any(v.key in line for v in chosen)]
    remarks = [f"{key}: {each.remark}" for key, each in estimates.items() if each.remark]
    bounds = [f"{key}: {each.remark}" for key, each in beside.items() if " bound" in each.remark]
    said = [*_of_windows(model), *_of_schedule(model, estimates), *unseen, *remarks, *bounds]
    said += _of_log_step(model, found, beside)
    said += [*_of_fit(found, problem, wrong, len(tests), ahead), *filter(None, [hint])]
    return Identified(
        scenario, log, estimates, beside, ahead, (*warnings, *said), known.combined, model, problem, found, known, tests
    )


def _estimates(problem: Problem, found: Fitted, known: Posterior) -> dict[str, Estimate]:
    model = problem.model
    robot = model.structure.robot
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
            float(values[n]), low, high, _told(problem, found, n, float(sd[n])), v.nominal, v.unit,
            _remark(v, found.x[n], sd[n], held=not problem.free[n]),
        )  # fmt: skip
    return estimates


def _told(problem: Problem, found: Fitted, n: int, sd: float) -> bool:
    """Whether the log tells a variable; one beside those asked for is never held, but may keep its prior."""
    variable = problem.model.variables[n]
    if not variable.beside:
        return bool(problem.free[n])
    return sd < inference.SEEN * variable.sd and not variable.bound_at(found.x[n])


def _remark(variable: Variable, x: float, sd: float, *, held: bool) -> str:
    if held:
        return "not told: stays nominal"
    if name := variable.bound_at(x):
        return f"on its {name} bound, {getattr(variable, name):.3g} {variable.unit}"
    off = abs(x - variable.mean) / variable.sd
    if off > 3:
        return f"{off:.1f} sd off its prior"
    return "told roughly: the interval is as wide as the prior" if sd > variable.sd and not variable.beside else ""


def _predicted(problem: Problem, found: Fitted) -> dict[str, Any]:
    """Errors (rms) of the held-out part over the noise, of all signals and of each."""
    held, windows = problem.predicted, problem.model.windows
    if not held.any():
        return {}
    own = {n: held & (problem.rows.signal == n) for n in range(len(windows.names))}
    own = {n: rows for n, rows in own.items() if rows.any()}
    return {
        "error_over_noise": float(np.sqrt((found.scaled[held] ** 2).mean())),
        "seconds": float(windows.held_out.sum() * windows.steps * windows.time_step),
        "signals": {windows.names[n]: float(np.sqrt((found.scaled[rows] ** 2).mean())) for n, rows in own.items()},
        "error": {windows.names[n]: float(np.sqrt((found.residuals[rows] ** 2).mean())) for n, rows in own.items()},
    }


def _of_windows(model: Fit) -> Iterator[str]:
    """Yield the parts of a log that are not fitted."""
    windows = model.windows
    if count := len(windows.pauses):
        seconds = float(np.diff(windows.pauses).sum())
        yield f"pauses: {count}, {seconds:.3g} s in all, in which nothing was measured; what follows each begins anew"
    if count := len(windows.missing):
        seconds = float(np.diff(windows.missing).sum())
        yield (
            f"commands are missing in {count} holes, {seconds:.3g} s in all: what happens in one is not fitted, and "
            "what follows begins anew"
        )
    if windows.constant:
        yield f"{several(windows.constant)}: the same all the time, not fitted"


def _of_schedule(model: Fit, chosen: Collection[str]) -> Iterator[str]:
    """Yield the remarks on P gains by time and on torque off."""
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
    """Yield the doubt by a simulator's time step, where velocities come as late as its would.

    One of first order has velocities of half a step before its angles: damping then acts late.
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
    found: Fitted, problem: Problem, wrong: Sequence[Whiteness], signals: int, ahead: Mapping[str, Any]
) -> list[str]:
    """Return the remarks on a fit as a whole."""
    said = []
    if found.clock:
        said.append(
            f"time stamps err by {found.clock:.2g} s (standard deviation), what was sampled at once together; this is "
            "counted as noise"
        )
    elif len(problem.model.windows.names) > 1 and len(set(problem.rows.stamp.tolist())) == len(problem.rows.stamp):
        said.append("no two signals share a time stamp: errors of the stamps are not told from noise, and not fitted")
    if wrong:
        said.append(f"{wrong[0].in_words} ({len(wrong)} of {signals} signals; intervals are widened)")
    if found.ended != "converged":
        said.append(
            f"the search still gained after {found.iterations} evaluations: fit fewer keys, or add a motion that tells "
            "them apart"
        )
    near = sum(cost <= min(found.costs) * (1 + _ONE) for cost in found.costs)
    if near < len(found.costs):
        said.append(f"{near} of {len(found.costs)} starts ended at this optimum (--starts with more of them is surer)")
    if found.unsettled >= SETTLED:
        said.append(
            f"the noise did not settle: estimated once more it would change by "
            f"{100 * found.unsettled:.0f} %, and the intervals with it"
        )
    if not ahead:
        said.append("nothing was held out: how well the values predict is not known")
    elif ahead["error_over_noise"] > 1.2:
        said.append(
            f"what was held out is predicted {ahead['error_over_noise']:.3g} times worse than the noise; intervals are "
            "wider by as much"
        )
    if line := inference.unexplained(found.noise, problem.samples.moved):
        said.append(line)
    return said
