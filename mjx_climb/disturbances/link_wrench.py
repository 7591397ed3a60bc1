"""A force and a moment on one link for a while: somebody touches a limb, or the sun bends it."""

import jax.numpy as jnp
import numpy as np
from jax import Array

from mjx_climb.component import parameter
from mjx_climb.disturbances.disturbance import Body, Disturbance, External
from mjx_climb.physics.spatial import quaternion_to_matrix


class LinkWrench(Disturbance):
    """A constant force and moment on one link, from `start` until before `stop`.

    `frame` is that of force and moment: "world", or "link", that of the link's joint with z along its axis.
    """

    KIND = "link_wrench"

    limb: Array = parameter("1", bounds=(0.0, np.inf), default=0.0, long_name="index of the limb")
    link: Array = parameter(
        "1", bounds=(0.0, np.inf), default=0.0, long_name="index of the link, from the base outwards"
    )
    force: Array = parameter("N", shape=(3,), bounds=(-np.inf, np.inf), default=0.0)
    moment: Array = parameter("N m", shape=(3,), bounds=(-np.inf, np.inf), default=0.0)
    at: Array = parameter("m", shape=(3,), bounds=(-np.inf, np.inf), default=0.0, long_name="point in the link's frame")
    start: Array = parameter("s", bounds=(0.0, np.inf), default=0.0)
    stop: Array = parameter("s", bounds=(0.0, np.inf), default=np.inf)
    frame: str = "world"

    def begins(self) -> Array:
        """The first instant; infinite without a wrench or a time."""
        some = (jnp.asarray(self.force) != 0).any() | (jnp.asarray(self.moment) != 0).any()
        return jnp.where(some & (self.stop > self.start), self.start, jnp.inf)

    def act(self, time: Array, body: Body) -> External:
        """The wrench of the window, by the Jacobian of the point where it acts."""
        limbs, links = body.frames.position.shape[:2]
        of_link = (np.arange(limbs)[:, None] == self.limb) & (np.arange(links) == self.link)
        touched = (of_link & (time >= self.start) & (time < self.stop))[..., None]
        rotation, point = body.frames.rotation, body.frames.position + jnp.matvec(body.frames.rotation, self.at)
        if self.frame == "link":
            force, moment = jnp.matvec(rotation, self.force), jnp.matvec(rotation, self.moment)
        else:
            to_base = quaternion_to_matrix(body.state.base_orientation).T
            force, moment = to_base @ self.force, to_base @ self.moment
        return body.under(jnp.where(touched, force, 0.0), jnp.where(touched, moment, 0.0), point)
