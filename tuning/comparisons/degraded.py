"""Gains on worse hardware, one thing at a time: the same unseen walks as drawn, and with that changed."""

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.execution.batch_axes import own_axes
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Scenario
from tuning.comparisons import judge as judging
from tuning.comparisons import paired, verdicts
from tuning.comparisons.side_by_side import VARIATION
from tuning.gains.gains_file import Whole
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem
from tuning.problem.objectives import Objective
from tuning.problem.variations import WORDS, Change, Factor, checked, paths_of, scalable, scaled
from tuning.results.judged import Degraded
from tuning.searches.shards import Counted, Rows
from tuning.searches.sweep import default_batch_size

AS_DRAWN = "as drawn"
METRICS = ("force_variation", "peak_foot_force", "peak_pull_force", "cost_of_transport", "peak_joint_torque")
SECTION = "hardware."
_MASSES = "mass_scale"


class Setting(NamedTuple):
    """Hardware that is made worse."""

    name: str  # as it was typed
    factors: Mapping[str, float]  # by words of `tuning.problem.variations.WORDS`, or paths
    keys: Mapping[
        str, Any
    ]  # paths, or keys of the section hardware, with values in place of the config's and the draw's


def setting(text: str) -> Setting:
    """Return a change, read from "delay=x2", "force_sensor.dead.LF=3.0", "contact.spread=0.5", or several with commas.

    Raises:
        ValueError: in a few words, the expected form.
    """
    from mjx_climb.scenario.yaml_text import pairs

    factors, changes = dict[str, float](), []
    for part in text.split(","):
        key, equals, value = (each.strip() for each in part.partition("="))
        if not equals:
            words = "|".join(WORDS)
            raise ValueError(f"expected {words}|PATH=xFACTOR, PATH=VALUE or a key of hardware, got {part!r}")
        try:
            factor = scaled(value)
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from None
        if factor is not None:
            factors[key] = factor
        elif key in WORDS:
            raise ValueError(f"{key}: expected a factor above 0, as x2, got {value!r}")
        else:
            of_hardware = key.partition(".")[0] not in Scenario.model_fields and key != _MASSES
            changes.append(f"{SECTION * of_hardware}{key}={value}")
    return Setting(text, factors, dict(pairs(changes, "worse")))


def worsened(scenario: mc.Scenario, drawn: mc.Parameters, worse: Setting) -> mc.Parameters:
    """Return the parameters of a draw with worse hardware; all else in them is as it was.

    Raises:
        ConfigError: a key that the scenario does not have, nothing there to scale, or contacts and joints that the
            time step cannot follow.
    """
    found: dict[str, Change] = {}
    for key, value in worse.keys.items():
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if number and (key in drawn.paths or not key.startswith(SECTION)):
            found[key] = value
        elif not key.startswith(SECTION):
            raise ConfigError("", f"worse: {key}", "a number", f"{value!r}")
    if others := {key: value for key, value in worse.keys.items() if key not in found}:
        other = own_parameters(scenario.with_overrides(others)).values
        there = {p: v for p, v in other.items() if any(key == p or key.startswith(f"{p}.") for key in others)}
        if not there:
            raise ConfigError("", "worse", "a number of the hardware", ", ".join(others))
        found |= there
    for quantity, factor in worse.factors.items():
        if not (own := scalable(drawn, paths_of(drawn, quantity))):
            drive = type(drawn.drive).__name__
            raise ConfigError("", "worse", f"{quantity} in the config or the draw to scale", f"none (drive: {drive})")
        found |= dict.fromkeys(own, Factor(factor))
    worst = checked(scenario, drawn, found, "worse: {}")
    check_time_step(scenario, "worse", worst)
    return worst


def together(draws: Sequence[mc.Parameters], members: int) -> mc.Parameters:
    """Return the members of all draws behind one another, so that a law is compiled once for all of them."""

    def joined(own: int, *values: Any) -> np.ndarray:
        arrays = [np.asarray(value) for value in values]
        if all(value.ndim == own and np.array_equal(value, arrays[0]) for value in arrays):
            return arrays[0]
        shape = np.broadcast_shapes(*(value.shape[value.ndim - own :] for value in arrays))
        return np.concatenate([np.broadcast_to(value, (members, 1, *shape)) for value in arrays])

    whole: mc.Parameters = jax.tree.map(joined, own_axes(draws[0]), *draws)
    return whole


@dataclasses.dataclass(frozen=True)
class Worse(judging.Draw):
    """Gains that walk through the members of a draw in each setting: all members of the first one first."""

    settings: tuple[str, ...] = ()  # the first one as drawn

    def identity(self) -> dict[str, Any]:
        """Return all that determines the walks, as plain JSON values."""
        return {**super().identity(), "kind": Degraded.KIND, "settings": list(self.settings)}

    def result(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Return the walks over settings, gains and members."""
        walks, members = self.dataset(arrays), self.rows // len(self.settings)
        each = [walks.isel(member=slice(at, at + members)) for at in range(0, self.rows, members)]
        each = [part.assign_coords(member=np.arange(members)) for part in each]
        whole = xr.concat(each, xr.Variable("setting", list(self.settings)), combine_attrs="override")
        return Degraded(whole, self.problem, ensemble=self.ensemble)


def draw_of(
    problem: Problem, gains: Mapping[str, AnyGains | Whole], ensemble: Ensemble, worse: Iterable[str], members: int
) -> Worse:
    """Return the work of `degrade`, whose arguments and errors these are."""
    drawn, settings = judging.draw_of(problem, gains, ensemble, members), [setting(text) for text in worse]
    names = (AS_DRAWN, *(each.name for each in settings))
    if len({*names}) < len(names):
        raise ConfigError("", "worse", "settings that differ", ", ".join(names[1:]))
    own = drawn.problem.parameters
    assert own is not None
    parameters = together([own, *(worsened(problem.scenario, own, each) for each in settings)], members)
    rows = members * len(names)
    walked = dataclasses.replace(drawn.problem, parameters=parameters, members=rows)
    size = default_batch_size(rows, problem.scenario.steps)
    return Worse(walked, drawn.gains, drawn.pd, drawn.ensemble, rows, size, names)


def degrade(
    scenario: mc.Scenario,
    gains: Mapping[str, AnyGains | Whole],
    ensemble: Ensemble,
    worse: Iterable[str],
    *,
    members: int = judging.MEMBERS,
    law: mc.Law | None = None,
    metrics: Iterable[mc.Metric] = mc.METRICS,
    engine: str = DEFAULT_ENGINE,
    out: str | os.PathLike[str] | None = None,
    progress: Counted | None = None,
) -> Degraded:
    """Simulate gains on unseen walks as drawn, and with worse hardware, one setting at a time.

    The members are the same in every setting but for its change. The other arguments are
    those of `tuning.evaluate`. `tuning.write(tuning.degrade(...), folder)` is `mjx-climb evaluate --worse`.

    Arguments:
        worse: settings, see `setting`: factors on delay, period, friction, backlash, noise, bias and armature as the
            config has them or a member drew them, values of keys of the section `hardware`, or factors and values of
            paths, as "contact.spread=0.5".

    Raises:
        ConfigError: a setting that changes nothing, or an ensemble that the scenario does not allow.
        ValueError: a setting that cannot be read.
        OutputError: `out` cannot be written, or holds unfinished walks of something else.
    """
    problem = Problem(scenario, law=law, metrics=mc.MetricTable(metrics), engine=engine)
    work = draw_of(problem, gains, ensemble, worse, members)
    found: Degraded = work.result(Rows(work, out).walk(progress))
    return found


class Degradation(NamedTuple):
    """The loss by worse hardware."""

    losses: Mapping[str, xr.Dataset]  # by gains: settings against their own walks as drawn, see `paired.compared`
    lead: Mapping[str, xr.Dataset]  # by setting: gains against the baseline in the same setting
    baseline: str  # the best rival of the first gains as drawn; pd where none held


def summary(walks: xr.Dataset) -> Degradation:
    """Return the differences between settings, and between gains in each of them, with their intervals."""
    goal, metrics = Objective((), ()), [name for name in METRICS if name in walks]
    names = walks["gains"].values.tolist()
    drawn = walks.sel(setting=AS_DRAWN, drop=True)
    means = judging.held(drawn)[VARIATION].mean("member").reindex(gains=names)
    baseline = verdicts.best_rival(verdicts.by_lost_walks(means, judging.failed(drawn).mean("member"))) or judging.PD
    losses = {}
    for name in names:
        own = walks.sel(gains=name, drop=True).rename(setting="gains").transpose("gains", "member")
        losses[name] = paired.compared(own, metrics, AS_DRAWN, goal)
    settings = walks["setting"].values.tolist()
    lead = {each: paired.compared(walks.sel(setting=each, drop=True), metrics, baseline, goal) for each in settings}
    return Degradation(losses, lead, baseline)
