"""Commands whose log tells the chosen parameters: candidates, the robot's limits, the choice.

Every candidate is carried out by the nominal model and scaled, segment by segment, until all limits hold. Of these the
one is taken whose log has the most Fisher information (D-optimal); the plain chirp, within the same limits, stands
beside it.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import mjx_climb as mc
from mjx_climb.execution import devices
from mjx_climb.hardware.stages import stages_of
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.robot.constants import Robot
from mjx_climb.robot_import.load import load_robot
from mjx_climb.scenario.messages import ConfigError
from tuning.background import Stage, silent
from tuning.identification.model import commanded
from tuning.identification.model.commanded import Carried, Commands
from tuning.identification.model.foot_mass import with_foot_mass
from tuning.identification.model.gripped import gripped_with_nuisances
from tuning.identification.model.predicted import CLOCK, with_nuisances
from tuning.identification.model.variables import Variable, begin, variables, with_all
from tuning.identification.plan import motions
from tuning.identification.plan.information import Information, information
from tuning.identification.plan.motions import Axes, Band
from tuning.identification.plan.rig import RATE, SETTLING, Rig, Segment
from tuning.identification.plan.settings import Excitation as Settings

FORCE_NOISE = 0.1  # N, of a force sensor, where the config has none
MIXES = (("multisine",), ("multisine", "reversals"), ("chirp", "reversals"), ("multisine", "steps", "reversals"))
PLAIN = "plain chirp"
_ROUNDS, _GROWING = 16, 4  # of scaling, and those in which a motion may become larger
FALL = 1.5  # s, the longest drop


class Motion(NamedTuple):
    """A motion within the limits."""

    name: str
    segments: Sequence[Segment]
    bound: Sequence[str]  # which limit binds each segment, and how far it is used
    targets: Float[np.ndarray, "time limb joint"]  # rad, at the rate of the commands


class Candidate(NamedTuple):
    """A motion, and the information of its log."""

    motion: Motion
    information: Information


@dataclasses.dataclass(frozen=True)
class Excited:
    """Commands, and their forecast before anyone turns the robot on."""

    FILE = "excitation.csv"  # by it the folder is known
    KIND = "excite"

    scenario: mc.Scenario
    asked: Settings
    robot: Robot
    period: float  # s, of the commands
    best: Candidate
    plain: Candidate
    candidates: tuple[Candidate, ...]
    carried: Carried  # by the nominal model, at the commands
    chosen: tuple[Variable, ...]  # variables that the log is to tell

    @property
    def time(self) -> np.ndarray:
        """Of the commands, s."""
        return np.arange(len(self.best.motion.targets)) * self.period

    @property
    def gain(self) -> float:
        """How many times smaller the deviations are than after the plain chirp, geometric mean with a 100 % prior."""
        better = self.best.information.score - self.plain.information.score
        return float(np.exp(better / (2 * len(self.chosen))))


def excite(
    scenario: mc.Scenario, fit: Sequence[str] | None = None, *, stage: Stage = silent, **settings: Any
) -> Excited:
    """Return the commands by which a log tells `fit`, keys of the scenario.

    Arguments:
        scenario: the nominal robot and its hardware.
        fit: keys as `mjx-climb identify` takes them.
        stage: opened for each longer work, see `tuning.background.Stage`.
        settings: fields of `tuning.identification.plan.settings.Excitation`.

    Raises:
        ConfigError: a key or setting that cannot be used, or limits that no motion keeps, in one line.
    """
    asked = Settings.make({**settings, **({} if fit is None else {"fit": tuple(fit)})}, "excite")
    return chosen(set_up(scenario, asked), stage=stage)


def set_up(scenario: mc.Scenario, asked: Settings) -> Rig:
    """Return the nominal robot as it is to be excited.

    Raises:
        ConfigError: a key that is none or that such a log cannot tell, or a P gain that shakes the joints.
    """
    own, held = scenario, asked.base == "held"
    wanted = variables(scenario, asked.fit, held=held)
    if not held:
        if others := [v.key for v in wanted if v.key.startswith(("robot.", "hardware.force_sensor.filter"))]:
            expected = "a key of the scenario or of the log with --base free"
            raise ConfigError("excite", f"--fit {others[0]}", expected, "one of the robot's or of a filter")
        scenario = commanded.swaying(scenario, asked.duration + SETTLING)
    for kp in asked.kp:
        check_time_step(scenario.with_overrides({"control.kp": kp}), f"--kp {kp:g}")
    nominal, robot = own_parameters(scenario), load_robot(scenario.robot)
    with_beside = with_nuisances if held else gripped_with_nuisances
    every = with_beside(own, wanted, ("position",) if held else ("position", "force"))
    beside = tuple(v for v in every if v.key not in {w.key for w in wanted})
    there, rubbing = with_all(wanted, scale, nominal, robot)
    if any(v.key == CLOCK for v in beside):  # commands that come late have their stage
        late = np.asarray(max(float(nominal.bus.command_delay), scenario.time_step))
        there = there.replace({"hardware.command_delay": late})
    stages = stages_of(there, scenario.time_step, rubbing)
    stages = stages._replace(command_delay=0) if held else stages
    with devices.on_host(), jax.enable_x64(True):
        robot = jax.tree.map(lambda value: np.asarray(value, float), with_foot_mass(robot, asked.mass))
    hold = round((scenario.hardware.control_period or 1 / RATE) / scenario.time_step)
    return Rig(own, scenario, asked, robot, nominal, stages, hold, wanted, beside)


def chosen(rig: Rig, *, stage: Stage = silent) -> Excited:
    """Return the best of the candidates within the limits, beside the plain chirp; errors as of `excite`."""
    with devices.on_host(), jax.enable_x64(True):
        made = candidates(rig)
        with stage("limits"):
            found, carried = within_limits(rig, made)
        with stage("information"):
            told = [Candidate(*each) for each in zip(found, informations(rig, found), strict=True)]
    best = int(np.argmax([one.information.score for one in told]))
    own = Carried(*(value[rig.lead * rig.hold :: rig.hold] for value in carried[best]))
    return Excited(rig.own, rig.asked, rig.robot, rig.period, told[best], told[0], tuple(told), own, rig.chosen)


def scale(variable: Variable) -> float:
    """Return the scale of a variable's standard deviation: its value, or the prior's where that is 0.

    Of a product of inertia too: it moves in another coordinate than its value.
    """
    shape = ".inertia." in variable.key and not variable.log
    return variable.sd if shape else abs(variable.nominal) or variable.sd


def candidates(rig: Rig) -> dict[str, list[Segment]]:
    """Return motions by name, not yet scaled, all of one length; the plain chirp is the first."""
    asked, axes = rig.asked, rig.axes()
    count, band = round(asked.duration / rig.period), Band(asked.low, asked.high)
    gains = asked.kp or (float(rig.parameters.joint_loop.kp),)
    mixes = (asked.family,) if asked.family else MIXES
    bands = (band, Band(asked.low, max(asked.high / 3, 2 * asked.low)))
    fall = _drop(rig)
    draw = np.random.default_rng(asked.seed)
    whole = count + sum(segment.stop - segment.start for segment in fall)
    made = {PLAIN: _segments(rig, axes, [(PLAIN, motions.plain_chirp)], gains, band, whole, draw)}
    for number, (part, mix) in zip(range(asked.candidates), itertools.cycle(itertools.product(bands, mixes))):
        families = [(name, motions.FAMILIES[name]) for name in mix]
        segments = _segments(rig, axes, families, gains, part, count, draw)
        segments += [each._replace(start=each.start + count, stop=each.stop + count) for each in fall]
        made[f"{number + 1}: {', '.join(mix)}, {part.low:g} to {part.high:.3g} Hz"] = segments
    return made


def _segments(
    rig: Rig, axes: Axes, families: Sequence[tuple[str, motions.Family]], gains: Sequence[float], band: Band,
    count: int, draw: np.random.Generator,
) -> list[Segment]:  # fmt: skip
    """Return the families in turn for each P gain, over so many commands."""
    each = list(itertools.product(gains, families))
    ends = np.linspace(0, count, len(each) + 1).round().astype(int)
    found = []
    for (kp, (name, family)), start, stop in zip(each, ends, ends[1:], strict=False):
        moved = np.zeros((stop - start, len(axes.room)))
        every = np.arange(len(axes.room))
        limbs = np.array_split(every, len(rig.robot.limbs)) if rig.asked.limb_by_limb else [every]
        turns = np.linspace(0, stop - start, len(limbs) + 1).round().astype(int)
        for limb, first, last in zip(limbs, turns, turns[1:], strict=False):
            time, some = np.arange(last - first) * rig.period, Axes(*(value[limb] for value in axes))
            moved[first:last, limb] = motions.tapered(family(some, time, band, draw), time)
        found.append(Segment(name, int(start), int(stop), kp, moved))
    return found


def _drop(rig: Rig) -> list[Segment]:
    """Return how the limbs are raised and then fall with the torque off, until the first limit is near."""
    if not rig.asked.drop:
        return []
    axes, kp = rig.axes(), float((rig.asked.kp or (rig.parameters.joint_loop.kp,))[-1])
    down = rig.falling().ravel()
    time, rise = np.arange(0, 1.5, rig.period), 1.0
    raised = Segment("raise", 0, len(time), kp, -0.7 * axes.room * down * motions.smooth(time / rise)[:, None])
    fall = round(FALL / rig.period)
    falling = Segment("drop", len(time), len(time) + fall, 0.0, np.repeat(raised.moved[-1:], fall, 0))
    targets = rig.targets(np.concatenate([raised.moved, falling.moved]))
    (carried,) = _carried(rig, [targets], [[raised, falling]])
    first = (rig.lead + len(time)) * rig.hold
    for end in range(fall, 0, -1):
        done = Carried(*(value[first : first + end * rig.hold] for value in carried))
        if rig.used(targets[len(time) : len(time) + 1], done)[0] <= rig.asked.margin:
            return [raised, falling._replace(stop=len(time) + end, moved=falling.moved[:end])]
    return [raised]


def _carried(rig: Rig, targets: Sequence[np.ndarray], segments: Sequence[list[Segment]]) -> list[Carried]:
    """Return the nominal model's walks of several motions, at each time step, the lead before the log included."""
    all_commands = _commands(rig, [np.nan_to_num(one) for one in targets], segments)
    done = commanded.in_batch(rig.run())(rig.robot, rig.parameters, all_commands)
    return [Carried(*one) for one in zip(*map(np.asarray, done), strict=True)]


def _commands(rig: Rig, targets: Iterable[np.ndarray], segments: Iterable[Sequence[Segment]]) -> Commands:
    """Return the commands of several motions, stacked."""
    each = itertools.starmap(rig.commands, zip(targets, segments, strict=True))
    stacked: Commands = jax.tree.map(lambda *parts: np.stack(parts), *each)
    return stacked


def within_limits(rig: Rig, made: dict[str, list[Segment]]) -> tuple[list[Motion], list[Carried]]:
    """Return the motions scaled so far that every limit holds with its margin, and their simulations.

    Raises:
        ConfigError: a limit that does not hold however small the motion, in one line.
    """
    margin, all_segments = rig.asked.margin, list(made.values())
    scales = [np.ones(len(segments)) for segments in all_segments]
    for number in range(_ROUNDS):
        targets = [_scaled(rig, *each) for each in zip(all_segments, scales, strict=True)]
        done, all_used = _carried(rig, targets, all_segments), []
        for segments, own, aim, carried in zip(all_segments, scales, targets, done, strict=True):
            used = [_used(rig, segment, aim, carried) for segment in segments]
            for n, (segment, (share, _)) in enumerate(zip(segments, used, strict=True)):
                if segment.name not in ("raise", "drop") and (share > margin or number < _GROWING):
                    own[n] *= np.clip((0.97 * margin / share) ** 0.8, 0.5, 1.0 if number >= _GROWING else 1.5)
            all_used.append(used)
        worst = max((each for used in all_used for each in used), key=lambda each: each[0])
        if worst[0] <= margin and number >= _GROWING:
            break
    else:
        expected = f"limits that hold with a share of {margin:g} of each"
        raise ConfigError("excite", worst[1], expected, f"{worst[0]:.3g} of it at any amplitude")
    found = []
    for (name, segments), used, aim in zip(made.items(), all_used, targets, strict=True):
        bound = tuple(f"{which}, {100 * share:.0f} % of it" for share, which in used)
        found.append(Motion(name, segments, bound, aim))
    return found, done


def _scaled(rig: Rig, segments: list[Segment], scales: np.ndarray) -> np.ndarray:
    return rig.targets(np.concatenate([scale * each.moved for each, scale in zip(segments, scales, strict=True)]))


def _used(rig: Rig, segment: Segment, targets: np.ndarray, carried: Carried) -> tuple[float, str]:
    start, stop = ((rig.lead + end) * rig.hold for end in (segment.start, segment.stop))
    return rig.used(targets[segment.start : segment.stop], Carried(*(value[start:stop] for value in carried)))


def informations(rig: Rig, found: Sequence[Motion]) -> list[Information]:
    """Return the information of each motion's log, at its rate and noise, about the chosen variables.

    The nuisances of `identify` are eliminated.
    """
    step, rate = rig.scenario.time_step, rig.asked.rate or 1 / rig.period
    count = int((len(found[0].targets) * rig.hold - 1) * step * rate) + 1
    rows = rig.lead * rig.hold + np.round(np.arange(count) / rate / step).astype(int)
    force_noise = rig.scenario.hardware.force_sensor.noise or FORCE_NOISE

    every = (*rig.chosen, *rig.beside)

    def logged(point: jax.Array, commands: Commands) -> jax.Array:
        done = rig.carried(point, commands)
        seen = [done.angles[rows].ravel() / rig.asked.noise]
        if rig.asked.base == "free":
            seen.append(rig.logged_force(point, done.force)[rows].ravel() / force_noise)
        return jnp.concatenate(seen)

    def along(direction: jax.Array, commands: Commands) -> jax.Array:
        tangent: jax.Array = jax.jvp(lambda point: logged(point, commands), (begin(every),), (direction,))[1]
        return tangent

    own = [1.0 if each.log else scale(each) for each in rig.chosen]
    directions = np.diag([*own, *(each.sd for each in rig.beside)])
    commands = _commands(rig, [one.targets for one in found], [one.segments for one in found])
    tangents = jax.jit(jax.vmap(jax.vmap(along, (0, None)), (None, 0)))(directions, commands)
    names = tuple(each.key for each in rig.chosen)
    return [
        information(names, white[: len(names)].T, np.ones(white.shape[1]), white[len(names) :].T)
        for white in np.asarray(tangents)
    ]
