"""Peer: `mujoco.rollout` of the bare dynamics on threads, from the rest stance, without any controller or grip."""

import numpy as np
from mujoco import rollout

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import load_spec


def bare_model(scenario: mc.Scenario) -> mujoco.MjModel:
    """Return the scenario's robot without contacts and constraints."""
    model = load_spec(scenario.robot).compile()
    model.opt.gravity[:] = scenario.gravity
    model.opt.timestep = scenario.time_step
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    return model


class Peer:
    """Robots that fall freely from the rest stance."""

    def __init__(self, scenario: mc.Scenario, count: int, steps: int, threads: int):
        self.model = bare_model(scenario)
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        mujoco.mj_resetDataKeyframe(self.model, self.data[0], 0)
        every = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(mujoco.mj_stateSize(self.model, every))
        mujoco.mj_getState(self.model, self.data[0], start, every)
        self.start = np.tile(start, (count, 1))
        self.states = np.empty((count, steps, len(start)))  # allocated once, so that the pages are warm
        self.sensed = np.empty((count, steps, 0))
        self.pool = rollout.Rollout(nthread=threads)

    def run(self) -> None:
        """Run all of the steps once."""
        self.pool.rollout(
            self.model, self.data, self.start, nstep=self.states.shape[1], state=self.states, sensordata=self.sensed
        )

    def close(self) -> None:
        """End the threads."""
        self.pool.close()
