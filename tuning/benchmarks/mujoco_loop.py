"""Peer: what a MuJoCo user would write for one robot, a Python loop with the controller between the halves of a step.

The walk's control law and grip come from `numpy_walk`. It works out no metrics.
"""

from collections.abc import Mapping

import numpy as np

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from tuning.benchmarks.mujoco_batch import Watch
from tuning.benchmarks.numpy_walk import BASE, FEET, Disturbance, Walker, cross, load


class Peer:
    """A robot on its way; `run` goes on from where the last one ended."""

    def __init__(self, scenario: mc.Scenario, gains: Mapping[str, np.ndarray]):
        """Begin a walk with gains (1, 6)."""
        self.model = load(scenario)
        self.data = mujoco.MjData(self.model)
        self.walker = Walker(self.model, scenario, gains)
        self.disturbance = Disturbance(scenario)
        self.step, self.cargo = 0, 0.0
        self.base_mass = self.model.body_mass[BASE]
        self.sites = [self.model.site(foot).id for foot in FEET]
        self.tibias = self.model.site_bodyid[self.sites]
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)

    def run(self, steps: int, watch: Watch | None = None) -> np.ndarray:
        """Walk on for some steps and return the qpos (19,)."""
        m, d, walker = self.model, self.data, self.walker
        for step in range(self.step, self.step + steps):
            if (cargo := self.disturbance.cargo(step)) != self.cargo:
                self.cargo = cargo
                m.body_mass[BASE] = self.base_mass + cargo
                mujoco.mj_setConst(m, mujoco.MjData(m))
            mujoco.mj_step1(m, d)
            foot = d.site_xpos[self.sites].T
            sensed, angles, rates = (v.reshape(-1, 3).T[..., None] for v in (d.sensordata, d.qpos[7:], d.qvel[6:]))
            walker(step, d.qpos[:3, None], foot[..., None], sensed, angles, rates)
            force = walker.foot_force[..., 0]
            # MuJoCo takes a body's force at its centre of mass
            d.xfrc_applied[self.tibias, :3] = force.T
            d.xfrc_applied[self.tibias, 3:] = cross(foot - d.xipos[self.tibias].T, force).T
            d.xfrc_applied[BASE] = self.disturbance.push(step)
            d.qfrc_applied[6:] = walker.torque[..., 0].T.ravel()
            if watch is not None:
                watch(step, walker, d.qpos[None], d.qvel[None])
            mujoco.mj_step2(m, d)
        self.step += steps
        return np.asarray(d.qpos)
