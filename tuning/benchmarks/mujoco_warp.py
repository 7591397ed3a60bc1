"""Peer: `mujoco_warp` of the bare dynamics of many robots on a GPU, from the rest stance, without any controller."""

import importlib.util
from collections.abc import Callable

import mjx_climb as mc
from mjx_climb.mujoco_import import mujoco
from tuning.benchmarks.mujoco_rollout import bare_model


def is_installed() -> bool:
    """Return whether the extra `compare` has brought the package."""
    return importlib.util.find_spec("mujoco_warp") is not None


class Peer:
    """Robots that fall freely from the rest stance; on a GPU a step is a CUDA graph, on a CPU a sequence of kernels."""

    def __init__(self, scenario: mc.Scenario, count: int):
        import mujoco_warp as mjwarp
        import warp

        warp.config.quiet = True
        model = bare_model(scenario)
        start = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, start, 0)
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
