"""Peers: MuJoCo's bare dynamics of many robots that fall from the rest stance, without any controller or grip."""

from collections.abc import Callable

import numpy as np
from mujoco import rollout

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from mjx_climb.robot.constants import load_spec


def _at_rest(scenario: mc.Scenario) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the scenario's robot without contacts and constraints, and its rest stance."""
    model = load_spec(scenario.robot).compile()
    model.opt.gravity[:] = scenario.gravity
    model.opt.timestep = scenario.time_step
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    return model, data


class Rollout:
    """`mujoco.rollout` on threads."""

    def __init__(self, scenario: mc.Scenario, count: int, steps: int, threads: int):
        self.model, rest = _at_rest(scenario)
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        every = mujoco.mjtState.mjSTATE_FULLPHYSICS
        start = np.empty(mujoco.mj_stateSize(self.model, every))
        mujoco.mj_getState(self.model, rest, start, every)
        self.start = np.tile(start, (count, 1))
        self.states = np.empty((count, steps, len(start)))  # allocated once, so that the pages are warm
        self.sensed = np.empty((count, steps, 0))
        self.pool = rollout.Rollout(nthread=threads)

    def run(self) -> None:
        """Run all of the steps once."""
        self.pool.rollout(
            self.model, self.data, self.start, nstep=self.states.shape[1], state=self.states, sensordata=self.sensed
        )


class Warp:
    """`mujoco_warp`, of the extra `compare`; on a GPU a step is a CUDA graph, on a CPU a sequence of kernels."""

    def __init__(self, scenario: mc.Scenario, count: int):
        import mujoco_warp as mjwarp
        import warp

        warp.config.quiet = True
        model, start = _at_rest(scenario)
        mujoco.mj_forward(model, start)
        self.model = mjwarp.put_model(model)
        # contacts and constraints are switched off; without room for one constraint the release does not accelerate
        self.data = mjwarp.put_data(model, start, nworld=count, nconmax=0, njmax=1)
        self.synchronize: Callable[[], object] = warp.synchronize
        self.step: Callable[[], object] = lambda: mjwarp.step(self.model, self.data)
        self.step()  # compiles the kernels, which a capture cannot
        if warp.get_device().is_cuda:
            with warp.ScopedCapture() as capture:
                self.step()
            self.step = lambda: warp.capture_launch(capture.graph)

    def run(self, steps: int) -> None:
        """Fall on for some steps, and wait for the last one."""
        for _ in range(steps):
            self.step()
        self.synchronize()
