"""A robot from a file as it stands, by the shapes in its file, its feet marked: do the limbs end there?"""

import numpy as np

from mjx_climb.mujoco_import import mujoco
from mjx_climb.rendering import marks
from mjx_climb.rendering.camera import AZIMUTH, View
from mjx_climb.rendering.canvas import Canvas
from mjx_climb.robot.constants import load_robot
from mjx_climb.robot.description import bare, compiled, described
from mjx_climb.robot.limbs import foot_of
from mjx_climb.scenario.model import RobotFile

SIZE = (800, 600)
_MARK = 0.04  # of the robot's half width, the radius of a mark
_AWAY = 3.4  # half widths


def stance(robot: str | RobotFile) -> np.ndarray:
    """Return the picture of a robot from a file in its rest stance, (600, 800, 3) uint8.

    Raises:
        ValueError: a robot that is known by name.
        RenderingError: no OpenGL on this machine.
    """
    if isinstance(robot, str):
        raise ValueError(f"expected a robot from a file, got {robot!r}")
    spec = bare(robot.file, {body.name for body in described(robot.file).bodies})
    sky, plane = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtGeom.mjGEOM_PLANE
    flat, head = mujoco.mjtBuiltin.mjBUILTIN_FLAT, spec.visual.headlight
    head.ambient, head.diffuse, head.active = [0.4] * 3, [0.5] * 3, 1
    spec.add_texture(name="sky", type=sky, builtin=flat, rgb1=[0.95] * 3, rgb2=[0.95] * 3, width=64, height=384)
    ground = spec.worldbody.add_geom(type=plane, pos=[0, 0, 1], size=[10, 10, 0.1], rgba=[0.8, 0.78, 0.75, 1])
    ground.name = "ground of the picture"
    model = compiled(robot.file, spec)
    data, limbs, loaded = mujoco.MjData(model), dict(robot.limbs.items()), load_robot(robot)
    held = dict(robot.locked.items())
    for number, name in enumerate(loaded.limbs):
        joints = limbs[name].joints
        held |= dict(zip(joints, loaded.stance_joints[number, : len(joints)], strict=True))
    data.qpos[:] = model.qpos0
    for name, value in held.items():
        data.joint(name).qpos[:] = value
    mujoco.mj_kinematics(model, data)
    if robot.base is not None:  # the file has the foot upright that it begins at
        base = model.body(robot.base).id
        root = model.body_rootid[base]
        upright = data.xmat[base].reshape(3, 3).T @ data.xmat[root].reshape(3, 3)
        mujoco.mju_mat2Quat(model.body_quat[root], upright.ravel())
        mujoco.mj_kinematics(model, data)
    feet = np.array([foot_of(model, data, limbs[name]) for name in loaded.limbs])
    model.geom(ground.name).pos[2] = feet[:, 2].mean()
    middle = (feet.mean(0) + data.xpos[1:].mean(0)) / 2
    half = float(np.linalg.norm(feet - middle, axis=1).max())

    def mark(scene: mujoco.MjvScene) -> None:
        for number, (name, foot) in enumerate(zip(loaded.limbs, feet, strict=True)):
            points = np.array([*(data.xanchor[model.joint(joint).id] for joint in limbs[name].joints), foot])
            marks.limb(scene, points, _MARK * half, marks.PATHS[number % len(marks.PATHS)])

    mujoco.mj_forward(model, data)
    with Canvas(model, *SIZE) as canvas:
        return canvas.draw(data, View(middle, _AWAY * half, AZIMUTH, np.array([0.0, 0, 1])), on_top=mark)
