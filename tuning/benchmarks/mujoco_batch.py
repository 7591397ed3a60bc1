"""Peer: what a MuJoCo user would write today for many robots, `mujoco.batch` stepping them on threads.

The walk's control law and grip come from `numpy_walk`. It works out no metrics.
"""

from collections.abc import Callable, Mapping

import numpy as np
from mujoco import batch

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from tuning.benchmarks.numpy_walk import BASE, FEET, Disturbance, Walker, cross, load

# after this step, with the walk's forces and the state (qpos, qvel) at its start
Watch = Callable[[int, Walker, np.ndarray, np.ndarray], None]


class Peer:
    """Robots on their way; `run` goes on from where the last one ended."""

    def __init__(self, scenario: mc.Scenario, gains: Mapping[str, np.ndarray], threads: int):
        model = load(scenario)
        self.walker = Walker(model, scenario, gains)
        self.disturbance = Disturbance(scenario)
        self.step, self.cargo = 0, 0.0
        self.base_mass = model.body_mass[BASE]
        self.sites = [model.site(foot).id for foot in FEET]
        self.tibias = model.site_bodyid[self.sites]
        # persistent, so that a step goes on from the kinematics that the controller saw
        self.batch = batch.Batch(model, len(gains["stiffness"]), threads, persistent=True)
        for field in ("site_xpos", "xipos", "sensordata"):
            self.batch.bind(field)
        self.batch.reset(keyframe=0, stage=mujoco.mjtStage.mjSTAGE_VEL)

    def run(self, steps: int, watch: Watch | None = None) -> np.ndarray:
        """Walk on for some steps and return the qpos (N, 19)."""
        b, walker = self.batch, self.walker
        qpos, qvel, site, xipos, sensed = b.qpos, b.qvel, b.site_xpos, b.xipos, b.sensordata
        joint_force, body_wrench = b.qfrc_applied, b.xfrc_applied
        count = len(qpos)

        def last(values: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(values.T)

        def joints(values: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(values.reshape(count, -1, 3).transpose(2, 1, 0))

        for step in range(self.step, self.step + steps):
            if (cargo := self.disturbance.cargo(step)) != self.cargo:
                self.cargo = cargo
                b.expand("body_mass")[:, BASE] = self.base_mass + cargo
                b.set_const()
                b.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
            foot = np.ascontiguousarray(site[:, self.sites].transpose(2, 1, 0))
            walker(step, last(qpos[:, :3]), foot, joints(sensed), joints(qpos[:, 7:]), joints(qvel[:, 6:]))
            # MuJoCo takes a body's force at its centre of mass
            arm = foot - xipos[:, self.tibias].transpose(2, 1, 0)
            body_wrench[:, self.tibias, :3] = walker.foot_force.transpose(2, 1, 0)
            body_wrench[:, self.tibias, 3:] = cross(arm, walker.foot_force).transpose(2, 1, 0)
            body_wrench[:, BASE] = self.disturbance.push(step)
            joint_force[:, 6:] = walker.torque.transpose(2, 1, 0).reshape(count, -1)
            if watch is not None:
                watch(step, walker, qpos, qvel)
            b.step(stage=mujoco.mjtStage.mjSTAGE_VEL)
        self.step += steps
        return np.asarray(qpos)
