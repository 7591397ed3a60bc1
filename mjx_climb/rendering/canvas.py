"""Pictures of a MuJoCo model from a context without a window."""

from collections.abc import Callable

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering import backend
from mjx_climb.rendering.camera import View

MAX_GEOMS = 4000
OPAQUE = 70  # of 255: a mark at least this bright hides what is behind it

Draw = Callable[[mujoco.MjvScene], None]


def nothing(scene: mujoco.MjvScene) -> None:
    """Add no geoms to a scene."""


class Canvas:
    """An offscreen picture of `width` by `height` pixels; a context manager that frees its OpenGL context."""

    def __init__(self, model: mujoco.MjModel, width: int, height: int):
        self._model = model
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._gl = backend.context(width, height)
        self.scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0

    def __enter__(self) -> "Canvas":
        return self

    def __exit__(self, *_: object) -> None:
        self._context.free()
        self._gl.free()

    def draw(self, data: mujoco.MjData, view: View, inside: Draw = nothing, on_top: Draw = nothing) -> np.ndarray:
        """Return the picture, (height, width, 3) uint8.

        Arguments:
            data: pose of the model.
            view: where the camera stands.
            inside: adds geoms among the model's.
            on_top: adds geoms that nothing hides, such as an arrow inside a leg or below the ground.
        """
        scene = self.scene
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, data, self._options, None, view.camera(), everything, scene)
        for geom in scene.geoms[: scene.ngeom]:
            # what stands still casts no shadow: on itself it is specks, as fine as the cells of the shadow map
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and self._model.geom_bodyid[geom.objid] == 0:
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR
        up = view.axes()[1]
        for eye in scene.camera:
            eye.up[:] = up
        inside(scene)
        picture = self._render()

        scene.ngeom = 0
        on_top(scene)
        if scene.ngeom:
            flags = scene.flags.copy()
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_SKYBOX):
                scene.flags[flag] = 0
            _lay_on(picture, self._render())
            scene.flags[:] = flags
        return picture

    def _render(self) -> np.ndarray:
        pixels = np.empty((self._rectangle.height, self._rectangle.width, 3), np.uint8)
        self._gl.make_current()
        mujoco.mjr_render(self._rectangle, self.scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rectangle, self._context)
        return pixels[::-1].copy()  # OpenGL's rows go upwards


def _lay_on(picture: np.ndarray, marks: np.ndarray) -> None:
    """Lay marks on black over a picture, in place; their soft edges stay soft."""
    rows = np.flatnonzero(marks.any((1, 2)))
    columns = np.flatnonzero(marks.any((0, 2)))
    if not rows.size:
        return
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    over = marks[part].astype(np.float32)
    share = np.minimum(over.max(-1, keepdims=True) / OPAQUE, 1)
    picture[part] = np.minimum(picture[part] * (1 - share) + over, 255)
