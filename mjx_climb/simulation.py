"""A simulation: a scenario, a control law, metrics and an engine, prepared once.

    simulation = Simulation(scenario)
    simulation.rollout(gains)                  one robot, full time histories
    simulation.metrics(gains, parameters)      a batch of robots, metrics alone
    simulation.jvp(gains, directions)          the same with tangents along directions in the gains
    simulation.vjp(gains, weights)             derivatives of weighted metrics by all gains, in reverse mode
    simulation.simulate(gains, parameters)     the metrics as a pure function, for jit, vmap, jvp, grad
    simulation.reset(gains), .step(state)      one robot, step by step, as pure functions

The walk itself is `mjx_climb.walk.step`; how a function of one robot is carried out for a batch is the affair of
`mjx_climb.execution`. `mjx_climb.functions` has the same in one call.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypedDict, TypeVar, Unpack

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import ArrayLike, DTypeLike

from mjx_climb import execution
from mjx_climb.component import given, real_numbers
from mjx_climb.control import Law, law_of
from mjx_climb.disturbances.disturbance import Disturbance
from mjx_climb.execution.batch_axes import axes_behind, batch_shape, is_traced, over_batch
from mjx_climb.execution.batches import Progress
from mjx_climb.gait.base_path import check_base
from mjx_climb.gait.first_holds import check_first_holds
from mjx_climb.hardware.actuator import Actuator
from mjx_climb.hardware.stages import Stages, stages_of
from mjx_climb.inputs.from_scenario import own_parameters, waiting_of
from mjx_climb.inputs.gait_values import TIMES, gait_of, scenario_with_gait
from mjx_climb.inputs.resolve import (
    AnyGains,
    Ready,
    WalkInputs,
    by_name,
    check_robots,
    checked,
    checked_dtype,
    ready,
    recorded,
    resolve,
    resolve_in,
    resolved_directions,
)
from mjx_climb.inputs.time_step import check_time_step
from mjx_climb.parameter_types import Parameters, path_of_gain
from mjx_climb.physics.contact.contact import Contact
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE, checked_engine
from mjx_climb.physics.state import State
from mjx_climb.robot_import.load import check_stance
from mjx_climb.scenario.model import Scenario
from mjx_climb.shapes import summed_to
from mjx_climb.trajectory import Trajectory
from mjx_climb.walk.control_loop import Action, JointTargets, checked_action
from mjx_climb.walk.metrics import METRICS, Metric, MetricTable
from mjx_climb.walk.sample import Sample
from mjx_climb.walk.step import Carry, Setup, advance, begin, constants_of_law, look_ahead, set_up, walk_of
from mjx_climb.walk.structure import Structure, planning_steps, structure
from mjx_climb.walks import (
    PART,
    Metrics,
    begun,
    histories_of,
    metrics_of,
    metrics_of_moved,
    next_samples,
    real_metrics,
    together,
)

Returned = TypeVar("Returned")


class BatchOptions(TypedDict, total=False):
    """Precision, size of shares and progress of a batch: see `Simulation.metrics`."""

    dtype: DTypeLike
    batch_size: int | None
    progress: Progress | None
    unsteady: bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SimulationState:
    """A robot between two steps; of a batch, every array has the batch axes first."""

    step: Array  # () how many have been made
    carry: Carry  # state between two steps
    setup: Setup  # the law with its gains, parameters, and constants computed from them

    @property
    def law(self) -> Law:
        """The law with its gains as they are now."""
        return self.setup.law

    @property
    def parameters(self) -> Parameters:
        """The parameters as they are now."""
        return self.setup.parameters

    @property
    def robot(self) -> State:
        """The mechanical state, joints limb after limb, as `mjx_climb.forward_dynamics` takes it."""
        state, shape = self.carry.state, self.step.shape
        angles, rates = (value.reshape(*shape, -1) for value in (state.joint_angles, state.joint_rates))
        return dataclasses.replace(state, joint_angles=angles, joint_rates=rates)


@dataclasses.dataclass(frozen=True, init=False, eq=False)
class Simulation:
    """A scenario under a control law, by an engine; immutable.

    Gains are given by name: `Gains`, a mapping, or a law; those not given are the law's own. Parameters take the place
    of the scenario's. A walk of given gains and parameters is the same by every method, to rounding.
    """

    scenario: Scenario
    law: Law  # with its own gains
    law_name: str  # where it is not the scenario's
    table: MetricTable  # the metrics
    engine: str
    smooth: bool
    contact: Contact | None  # in place of the scenario's, None: the scenario's
    drive: Actuator | None
    disturbances: tuple[Disturbance, ...]  # beside the scenario's
    parameters: Parameters | None  # in place of the scenario's, None: these

    def __init__(
        self,
        scenario: Scenario,
        law: Law | None = None,
        metrics: Iterable[Metric] = METRICS,
        engine: str = DEFAULT_ENGINE,
        *,
        contact: Contact | None = None,
        drive: Actuator | None = None,
        disturbances: Iterable[Disturbance] = (),
        parameters: Parameters | None = None,
        smooth: bool = False,
    ) -> None:
        """Prepare a simulation.

        Arguments:
            scenario: robot, ground, gait and disturbances.
            law: the control law with its gains, the scenario's own where None.
            metrics: metrics of walks, as `mjx_climb.METRICS + (mine,)`.
            engine: the dynamics, one of `mjx_climb.ENGINES`.
            contact: holds feet to the ground, in place of the scenario's gripper.
            drive: turns the joints, in place of the scenario's servos.
            disturbances: act beside the scenario's cargo and pushes.
            parameters: in place of the scenario's wherever a method is given none, with any batch axes: many calls on
                the same ones check them once.
            smooth: for searches: no gripper is torn off by any force (`peak_pull_force` tells), and the metrics
                have smooth companions, see `mjx_climb.walk.metrics`.

        Raises:
            ConfigError: no such engine, or a rest stance that is singular.
            RuntimeError: a process that was forked after JAX had begun.
            ValueError: no control law, contact, actuator or disturbance, or two metrics of one name.
        """
        checked_engine(engine)
        check_stance(scenario)
        check_base(scenario)
        check_first_holds(scenario)
        vars(self).update(  # frozen from here on
            scenario=scenario,
            law=law_of(scenario) if law is None else checked(law, Law),
            law_name="" if law is None else type(law).__name__,
            table=MetricTable(metrics),
            engine=engine,
            smooth=smooth,
            contact=None if contact is None else checked(contact, Contact),
            drive=None if drive is None else checked(drive, Actuator),
            disturbances=tuple(checked(each, Disturbance) for each in disturbances),
            parameters=parameters,
        )

    @functools.cached_property
    def structure(self) -> Structure:
        """The structure of a walk under the simulation's own parameters."""
        return self._structure(self._given(None), {})

    @functools.cached_property
    def _own(self) -> dict[np.dtype, tuple[Ready, list[Structure]]]:
        """The simulation's own parameters by precision, ready for walks, and their structure, once asked for."""
        return {}

    def _resolved(self, gains: AnyGains | None, parameters: Parameters | None, dtype: DTypeLike) -> WalkInputs:
        """Return the inputs of walks as arrays of NumPy."""
        if parameters is not None:
            return resolve_in(self.scenario, self.law, gains, self._given(parameters), dtype)
        if (precision := checked_dtype(dtype)) not in self._own:
            with jax.enable_x64(True):
                self._own[precision] = ready(self.scenario, self._given(None), precision), []
        return resolve_in(self.scenario, self.law, gains, self._own[precision][0], precision)

    def _structure_of_walks(self, resolved: WalkInputs) -> Structure:
        """Return the structure of walks, made once of those whose gains change no parameter."""
        own, made = self._own.get(resolved.parameters.gravity.dtype, (None, []))
        if own is None or resolved.walked is not own.walked:
            return self._structure(resolved.walked, resolved.called)
        if not made:
            made.append(self._structure(resolved.walked, resolved.called))
        return made[0]

    def _given(self, parameters: Parameters | None) -> Parameters:
        """Return parameters, the simulation's own where None, with its own contact, drive and disturbances."""
        given = self.parameters if parameters is None else parameters
        given = own_parameters(self.scenario) if given is None else given
        contact = given.contact if self.contact is None else self.contact
        drive = given.drive if self.drive is None else self.drive
        waiting = given.waiting
        if waiting is None and self.contact is not None:
            waiting = waiting_of(self.scenario, self.contact)
        disturbances = given.disturbances + self.disturbances
        return dataclasses.replace(given, contact=contact, drive=drive, disturbances=disturbances, waiting=waiting)

    @functools.cached_property
    def _real_metrics(self) -> list[str]:
        """The names of the metrics that have derivatives."""
        return real_metrics(self.structure, own_parameters(self.scenario))

    @functools.cached_property
    def _steady(self) -> bool:
        """True: the time step is short enough for the scenario's own contacts and joints; else it is refused."""
        check_time_step(self.scenario)
        return True

    def _structure(self, parameters: Parameters, called: Mapping[str, str]) -> Structure:
        """Return the structure of a walk under these parameters, which decide about the stages of hardware."""
        return structure(
            self.scenario, self.engine, parameters, law=self.law, metrics=self.table, smooth=self.smooth,
            called=lambda name: called.get(name, f"parameters.{name}"),
        )  # fmt: skip

    def rollout(
        self,
        gains: AnyGains | None = None,
        parameters: Parameters | None = None,
        *,
        dtype: DTypeLike = np.float64,
        targets: Float[np.ndarray, "time limb joint"] | None = None,
    ) -> Trajectory:
        """Walk one robot, on the CPU, and return the full time histories.

        Arguments:
            gains: in place of the law's own.
            parameters: in place of the scenario's.
            dtype: precision of the simulation; float64 needs no setting of JAX's.
            targets: of the joints in each step, rad, in place of the law's commands, as `JointTargets`.

        Raises:
            ConfigError: a time step too long for the scenario's contacts and joints.
            ValueError: batched gains or parameters, gains that the law does not have, or targets of another shape.
        """
        resolved = self._resolved(gains, parameters, dtype)
        if resolved.shape != ():
            raise ValueError("rollout walks one robot: for a batch of gains or parameters use rollout_metrics")
        check_time_step(self.scenario, parameters=resolved.walked)
        shape = self._structure_of_walks(resolved)
        robot = shape.robot
        under = () if targets is None else (np.asarray(targets, dtype),)
        if under and under[0].shape != (expected := (shape.steps, len(robot.limbs), robot.joints)):
            raise ValueError(f"targets: expected shape {expected}, got {under[0].shape}")
        samples = _walked(shape, resolved.law, resolved.parameters, *under)
        return Trajectory(
            scenario=scenario_with_gait(self.scenario, {} if gains is None else by_name(gains)),
            gains=recorded(self.scenario, gains, resolved),
            parameters=jax.tree.map(functools.partial(np.asarray, dtype=dtype), resolved.own),
            limbs=robot.limbs,
            law=self.law_name if targets is None else "JointTargets",
            **{name: np.asarray(value) for name, value in vars(samples).items()},
        )

    def metrics(
        self,
        gains: AnyGains | None = None,
        parameters: Parameters | None = None,
        *,
        dtype: DTypeLike = np.float32,
        batch_size: int | None = None,
        progress: Progress | None = None,
        unsteady: bool = False,
    ) -> dict[str, np.ndarray]:
        """Walk a batch of robots on all devices and return their metrics; memory does not grow with time.

        Arguments:
            gains: in place of the law's own, with leading batch axes: `Gains(damping=(..., 6), ...)`.
            parameters: with leading batch axes that broadcast with the gains'.
            dtype: precision of the simulation.
            batch_size: at most so many robots at once, one such share at a time on a GPU and one on each core of a CPU.
                Few robots walk on the CPU although there is a GPU: they are there sooner.
            progress: called with the number of robots that have walked and the number in all, after each share.
            unsteady: walk robots too whose own contacts or joints the time step is too long for, as searches do, which
                leave them out of their results.

        Returns:
            Arrays with the batch axes of gains and parameters, by the names of the metrics; NaN and -1 as `simulate`
            says.

        Raises:
            ConfigError: a time step too long for the contacts and joints of a robot.
            ValueError: shapes that do not broadcast, gains that the law does not have, or cannot have, parameters that
                no scenario could have, no robots, or another precision than float32 and float64.
        """
        how = BatchOptions(dtype=dtype, batch_size=batch_size, progress=progress, unsteady=unsteady)
        return self._run(metrics_of, gains, parameters, **how)[0]

    def histories(
        self, gains: AnyGains | None = None, parameters: Parameters | None = None, **how: Unpack[BatchOptions]
    ) -> dict[str, np.ndarray]:
        """Walk a batch of robots and return metrics as `metrics` does, and some histories over time beside them.

        Returns:
            The metrics, and arrays (*batch, 2, stretches), by the names of `mjx_climb.walks.LINES`, in their units.
            These are the least and the largest value in each of `stretches(scenario.steps)`, not finite from where the
            state stopped being finite.
        """
        return together(self._run(histories_of, gains, parameters, over_time=True, **how)[0])

    def jvp(
        self, gains: AnyGains, directions: AnyGains, parameters: Parameters | None = None, **how: Unpack[BatchOptions]
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Walk a batch of robots and return metrics, and their tangents along k directions in the gains.

        A direction costs about as much as the walk itself, and nothing is stored over time. The other arguments and
        errors are those of `metrics`.

        Arguments:
            directions: rates of change of the gains, in their units and by their names: values (k, *batch, n), of
                length 1 and for `kp`, `kd` and `ki` (k, *batch), with all batch axes of the gains, of their sizes or
                of 1. A gain of the law without rates stays as it is.

        Returns:
            The metrics (*batch), and the tangents (k, *batch) of those that are real numbers.

        Raises:
            ValueError: rates of a gain that the law does not have, or `kp`, `kd` or `ki` in one of two `Gains` alone.
        """
        return self._run(metrics_of_moved, gains, parameters, directions, **how)

    def vjp(
        self,
        gains: AnyGains,
        weights: Mapping[str, ArrayLike],
        parameters: Parameters | None = None,
        **how: Unpack[BatchOptions],
    ) -> dict[str, np.ndarray]:
        """Walk a batch of robots and return the derivatives, by all the gains given, of k weighted sums of metrics.

        Reverse mode: it costs as much for one gain as for hundreds. The other arguments and errors are those of
        `metrics`.

        Arguments:
            weights: of the metrics in the sums, by the names of those that are real numbers, (k, *batch) each.

        Returns:
            Arrays (k, ...) by the names of the gains, of their shapes behind the first axis; 0 for times of the gait.

        Raises:
            ValueError: weights of another shape, of no metric, or of a metric in whole numbers.
        """
        resolved, run = self._prepared(gains, parameters, over_time=False, **how)
        batch, dtype = resolved.shape, resolved.parameters.gravity.dtype
        real = self._real_metrics
        if wrong := [name for name in weights if name not in real]:
            raise ValueError(
                f"weights.{wrong[0]}: expected one of {', '.join(real)}, the metrics that are real numbers"
            )
        summed = {n: np.asarray(real_numbers(f"weights.{n}", value), dtype) for n, value in weights.items()}
        counts = {len(value) for value in summed.values() if value.ndim and value.shape[1:] == batch}
        if len(counts) != 1 or any(value.shape != (*counts, *batch) for value in summed.values()):
            got = ", ".join(f"{name} {value.shape}" for name, value in summed.items())
            raise ValueError(f"weights: expected shapes (k, {', '.join(map(str, batch))}), got {got or 'none'}")
        names = [name for name in by_name(gains) if name not in TIMES]
        known = {*resolved.law.GAINS, *(name for name in names if path_of_gain(name) in resolved.called)}
        robots, shape = self._moving(resolved, [name for name in names if name in known])
        robots = robots._replace(weights={name: np.moveaxis(value, 0, -1) for name, value in summed.items()})
        _, gradients = run(metrics_of_moved, shape, robots)
        found = {name: np.moveaxis(value, len(batch), 0) for name, value in gradients.items()}
        nothing = np.zeros((*counts, 1), dtype)
        return {name: summed_to(found.get(name, nothing), np.shape(value)) for name, value in by_name(gains).items()}

    def _run(
        self,
        function: Callable[..., Metrics],
        gains: AnyGains | None,
        parameters: Parameters | None,
        directions: AnyGains | None = None,
        *,
        over_time: bool = False,
        **how: Unpack[BatchOptions],
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return a function's results for all robots of a batch, and their tangents if there are directions."""
        resolved, run = self._prepared(gains, parameters, over_time=over_time, **how)
        law, own, batch = resolved[:3]
        if directions is None:
            shape = self._structure_of_walks(resolved)
            return run(function, shape, execution.Robots((law, own), resolved.axes, batch)), {}
        along = resolved_directions(resolved, gains, directions)
        robots, shape = self._moving(resolved, along)
        values, tangents = run(function, shape, robots._replace(directions=along))
        return values, {name: np.moveaxis(value, len(batch), 0) for name, value in tangents.items()}

    def _prepared(
        self, gains: AnyGains | None, parameters: Parameters | None, *, over_time: bool, **how: Unpack[BatchOptions]
    ) -> tuple[WalkInputs, Callable[..., Any]]:
        """Return the inputs of the walks as arrays of NumPy, and `execution.run` with its options.

        Too long a time step is refused, unless `unsteady`.
        """
        resolved = self._resolved(gains, parameters, how.get("dtype", np.float32))
        if how.get("unsteady"):
            _ = self._steady
        else:
            check_time_step(self.scenario, parameters=resolved.walked)
        batch_size, progress = how.get("batch_size"), how.get("progress")
        return resolved, functools.partial(execution.run, over_time=over_time, batch_size=batch_size, progress=progress)

    def _moving(self, resolved: WalkInputs, names: Iterable[str]) -> tuple[execution.Robots, Structure]:
        """Return the arguments of `metrics_of_moved` for derivatives by some gains, and their structure."""
        law, own = resolved[:2]
        values = own.values
        moving = {n: np.asarray(getattr(law, n) if n in law.GAINS else values[path_of_gain(n)]) for n in names}
        of_moving = {name: law.AXES.get(name, 0) for name in moving}
        shape = self._structure_of_walks(resolved)
        paths = [path_of_gain(name) for name in moving if name not in law.GAINS]
        shape = shape._replace(stages=stages_of(resolved.walked, shape.time_step, shape.robot, paths))
        return execution.Robots((moving, law, own), (of_moving, *resolved.axes), resolved.shape), shape

    def simulate(self, gains: AnyGains | None = None, parameters: Parameters | None = None) -> Metrics:
        """Return the metrics as a pure function of gains and parameters, for `jit`, `vmap`, `jvp`, `jacfwd` and `grad`.

        Arguments:
            gains: in place of the law's own, with any leading batch axes; their precision is the simulation's.
            parameters: with leading batch axes that broadcast with the gains'. Values that JAX traces may be such
                that decides about a stage of hardware only where the scenario has that stage.

        Returns:
            Arrays with the batch axes, named and in units as the metrics say. NaN stands for undefined values:
            `detached_at` while all limbs hold (`detached_limb` is then -1, else the index of the limb). Where the state
            stopped being finite, `diverged`, the others are those of the walk until then.

        Raises:
            ConfigError: a time step too long for the scenario's contacts and joints.
            ValueError: gains that the law does not have, or cannot have, a metric that does not keep its shapes, or
                parameters that JAX traces and that decide about hardware.
        """
        leaves = jax.tree.leaves(self.law if gains is None else gains)
        dtypes = [leaf.dtype for leaf in leaves if hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jnp.floating)]
        precision = jnp.result_type(*(dtypes or [float]))
        resolved = resolve(self.scenario, self.law, gains, self._given(parameters), precision)
        check_time_step(self.scenario, parameters=resolved.walked)
        walk = _carried_out(metrics_of, self._structure(resolved.walked, resolved.called))
        return over_batch(walk, resolved[:2], resolved.axes, resolved.shape)

    def reset(
        self,
        gains: AnyGains | None = None,
        parameters: Parameters | None = None,
        *,
        batch: int | tuple[int, ...] = (),
        dtype: DTypeLike | None = None,
        stages: Stages | None = None,
    ) -> SimulationState:
        """Return robots in the rest stance with all grippers shut: one, or a batch; pure and compiled.

        Arguments:
            gains: in place of the law's own, with any leading batch axes.
            parameters: in place of the scenario's, with batch axes that broadcast with the gains'.
            batch: further axes, where neither has them: (64,), or 64, for 64 equal robots.
            dtype: precision of the simulation; JAX's own setting where None.
            stages: those of the hardware, for any parameters, which JAX may trace then.

        Raises:
            ConfigError: a time step too long for the robot's contacts and joints.
            ValueError: gains that the law does not have, shapes that do not broadcast, no robots, or parameters that
                JAX traces and that decide about hardware.
        """
        sizes = tuple(batch) if isinstance(batch, Iterable) else (batch,)
        precision = jnp.result_type(float) if dtype is None else dtype
        given = self._given(parameters)
        resolved = resolve(self.scenario, self.law, gains, given, precision, compiled=stages is not None)
        if stages is None:
            structure = self._structure(resolved.walked, resolved.called)
        else:
            structure = self.structure._replace(stages=stages)
        check_time_step(self.scenario, parameters=resolved.walked)
        if not all(isinstance(count, int | np.integer) and count >= 0 for count in sizes):
            raise ValueError(f"batch: expected whole numbers of robots, got {sizes}")
        shape = batch_shape(others={"gains and parameters": resolved.shape, "batch": sizes})
        check_robots(shape)
        begun: SimulationState = over_batch(functools.partial(_start, structure), resolved[:2], resolved.axes, shape)
        return begun

    def step(
        self, state: SimulationState, action: Action = None, gains: AnyGains | None = None
    ) -> tuple[SimulationState, Sample]:
        """Return the robots one time step later, and the sample of this step; pure and compiled.

        Arguments:
            state: the result of `reset` or of the last `step`.
            action: for this step, in place of the law, which then stays as it is; for all robots, or with the batch
                axes of the state. None: the law's command.
            gains: from this step on, as of `with_gains`.

        Returns:
            The state after the step, and a sample with the fields of `mjx_climb.Trajectory`, batch axes in place of
            time: the state at the start of the step, and the forces and accelerations that act in it.

        Raises:
            ValueError: an action of another shape; gains as of `with_gains`.
        """
        if gains is not None:
            state = self.with_gains(state, gains)
        shape = state.step.shape
        action = checked_action(action, self.structure.robot, state.parameters.gravity.dtype, shape)
        axes = axes_behind(state, shape), jax.tree.map(lambda _: 2 if isinstance(action, JointTargets) else 1, action)
        one_step: Callable[..., tuple[SimulationState, Sample]] = _carried_out(_step, self._structure_of(state))
        return over_batch(one_step, (state, action), axes, shape)

    def _structure_of(self, state: SimulationState) -> Structure:
        """Return the structure of a robot's walk, with the stages of hardware and the gait that it began with."""
        planning = planning_steps(self.scenario, state.parameters)
        return self.structure._replace(stages=state.setup.hardware.stages, planning=planning)

    def with_gains(self, state: SimulationState, gains: AnyGains) -> SimulationState:
        """Return a robot, or a batch of them with its axes in front, that goes on with other gains; pure.

        Gains that are not given stay; so does the law's memory. It works the law out anew: call it when gains
        change.

        Raises:
            ValueError: gains that the law does not have, or cannot have, or for more robots than there are; a gait; a
                `ki` of a robot that began without.
        """
        if gait := gait_of(by_name(gains)):
            raise ValueError(f"gains.{next(iter(gait))}: expected none, a robot that walks keeps its gait")
        shape = state.step.shape
        own = state.parameters
        resolved = resolve(self.scenario, state.law, gains, own, own.gravity.dtype, compiled=True)
        if resolved.shape != shape:
            raise ValueError(f"gains: expected batch axes that broadcast to the state's {shape}, got {resolved.shape}")
        structure, ki = self._structure_of(state), resolved.walked.joint_loop.ki
        if "control.ki" in resolved.called and not structure.stages.integral and (is_traced(ki) or given(ki)):
            raise ValueError("gains.ki: expected 0, as the robot began without an integral gain, got another value")
        change, axes = functools.partial(_with_law, structure), (axes_behind(state, shape), *resolved.axes)
        changed: SimulationState = over_batch(change, (state, *resolved[:2]), axes, shape)
        return changed


def _walked(
    structure: Structure, law: Law, parameters: Parameters, targets: Float[np.ndarray, "time limb joint"] | None = None
) -> Sample:
    """Return all samples of a walk, in parts by one program for walks of any length and time step."""
    steps, period = structure.steps, structure.planning or 1
    length, time_step = period * max(1, PART // period), np.asarray(structure.time_step, parameters.gravity.dtype)
    structure, parts = structure._replace(steps=length, time_step=0.0), list[Sample]()
    carry = execution.run_one(begun, structure, law, parameters, time_step)
    for first in range(0, steps, length):
        under = () if targets is None else (targets[np.minimum(np.arange(first, first + length), steps - 1)],)
        known = law, parameters, time_step, carry, np.asarray(first, np.int32)
        carry, samples = execution.run_one(next_samples, structure, *known, *under)
        parts.append(samples)
    whole: Sample = jax.tree.map(lambda *each: np.concatenate(each)[:steps], *parts)
    return whole


@functools.partial(jax.jit, static_argnums=0)
def _start(structure: Structure, law: Law, parameters: Parameters) -> SimulationState:
    setup = set_up(structure, law, parameters)
    return SimulationState(jnp.zeros((), jnp.int32), begin(walk_of(structure, setup)), setup)


def _step(structure: Structure, state: SimulationState, action: Action) -> tuple[SimulationState, Sample]:
    walk, carry = walk_of(structure, state.setup), state.carry
    if structure.planning:
        at_tick = state.step % structure.planning == 0
        carry = jax.lax.cond(at_tick, lambda: look_ahead(walk, carry, state.step), lambda: carry)
    carry, sample = advance(walk, carry, state.step, action)
    return SimulationState(state.step + 1, carry, state.setup), sample


@functools.lru_cache(maxsize=128)
def _carried_out(function: Callable[..., Returned], structure: Structure) -> Callable[..., Returned]:
    """Return a function of one robot, for batches too: the same for equal arguments, so that it is compiled once."""
    return execution.over_robots(functools.partial(function, structure))


@functools.partial(jax.jit, static_argnums=0)
def _with_law(structure: Structure, state: SimulationState, law: Law, parameters: Parameters) -> SimulationState:
    """A state with another law; the law's memory stays, but for values that its `init` makes of the gains alone."""
    setup, carry = set_up(structure, law, parameters), state.carry
    walk, (before, tree) = walk_of(structure, setup), jax.tree.flatten(carry.memory.law)
    begun = begin(walk)
    pairs = zip(constants_of_law(walk, begun), jax.tree.leaves(begun.memory.law), before, strict=True)
    mixed = [jnp.where(constant, new, old) for constant, new, old in pairs]
    carry = carry._replace(memory=carry.memory._replace(law=jax.tree.unflatten(tree, mixed)))
    return SimulationState(state.step, carry, setup)
