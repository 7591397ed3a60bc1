"""Robots stepped by hand: `Simulation.reset` and `step` for a batch, whose axes are in front of every array."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from mjx_climb.control import Law
from mjx_climb.dynamics import DEFAULT_ENGINE
from mjx_climb.quantities.batches import axes_behind, over_batch
from mjx_climb.quantities.parameters import Parameters
from mjx_climb.rollouts.resolve import AnyGains, check_robots, checked_dtype
from mjx_climb.scenario.model import Scenario
from mjx_climb.simulation import Simulation, SimulationState
from mjx_climb.walk.control_loop import Action, JointTargets
from mjx_climb.walk.sample import Sample


class Environment:
    """A scenario's robots, to be stepped by hand under its law or another, or under actions of one's own.

    ```python
    env = mjx_climb.Environment(scenario)
    state = env.reset(gains, parameters)
    state, sample = env.step(state)
    ```

    `reset` and `step` are pure and compiled, for `jit`, `vmap`, `scan` and derivatives; made again from equal
    arguments, an environment is not compiled again. The walk is that of `mjx_climb.rollout`, and goes on where a
    rollout would end.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        law: Law | None = None,
        engine: str = DEFAULT_ENGINE,
        dtype: DTypeLike | None = None,
    ) -> None:
        """Prepare an environment.

        Arguments:
            scenario: what walks where; its parameters are the default.
            law: the control law, the scenario's own where None.
            engine: the dynamics, one of `mjx_climb.ENGINES`.
            dtype: precision of the simulation; JAX's own setting where None.

        Raises:
            ConfigError: no such engine.
            ValueError: no control law, or another precision than float32 and float64.
        """
        self.scenario = scenario
        self.simulation = Simulation(scenario, law, engine=engine)
        self.dtype: np.dtype = checked_dtype(jnp.result_type(float) if dtype is None else dtype)

    def reset(
        self, gains: AnyGains | None = None, parameters: Parameters | None = None, *, batch: tuple[int, ...] = ()
    ) -> SimulationState:
        """Return robots in the rest stance with all grippers shut.

        Arguments:
            gains: in place of the law's own, by name, with any leading batch axes.
            parameters: with leading batch axes that broadcast with the gains'; the scenario's own where None.
            batch: further axes, where neither has them: `batch=(64,)` for 64 equal robots.

        Raises:
            ValueError: shapes that do not broadcast, gains that the law does not have, or cannot have, or parameters
                with hardware that the scenario does not have.
        """
        resolved = self.simulation.resolved_for_steps(gains, parameters, self.dtype)
        shape = jnp.broadcast_shapes(resolved.shape, tuple(batch))
        check_robots(shape)
        state: SimulationState = over_batch(
            self.simulation.start, (resolved.law, resolved.parameters), resolved.axes, shape
        )
        return state

    def step(
        self, state: SimulationState, action: Action = None, gains: AnyGains | None = None
    ) -> tuple[SimulationState, Sample]:
        """Return the robots one time step later, and all that is known about this step.

        Arguments:
            state: what `reset` or the last `step` returned.
            action: for this step, for all robots or with the batch axes of the state; None: what the law commands. The
                law stays as it is while actions take its place.
            gains: from this step on, in place of the law's, by name, `kp` and `kd` too, for all robots or with the
                batch axes of the state. Those not given stay; so does what the law remembers.

        Returns:
            The state after the step, and a sample with the fields of `mjx_climb.Trajectory`, batch axes in place of
            time, which is the state at the start of the step, and the forces and accelerations that act in it.

        Raises:
            ValueError: gains as of `reset`, or for more robots than there are.
        """
        if gains is not None:
            state = self.simulation.with_gains(state, gains)
        shape = state.step.shape
        acting: Action = jax.tree.map(lambda value: jnp.asarray(value, self.dtype), action)
        axes = (axes_behind(state, shape), jax.tree.map(lambda _: 2 if isinstance(action, JointTargets) else 1, action))
        after: tuple[SimulationState, Sample] = over_batch(self.simulation.step, (state, acting), axes, shape)
        return after
