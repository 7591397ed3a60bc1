"""The force on a foot as logged: a share of it, an offset, and a share of another axis."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from tuning.identification.model.variables import Place


def logged_force(places: Sequence[Place], x: Array, limbs: Sequence[str], force: Array) -> Array:
    """Return the logged forces (..., limb, 3) N of given readings, at coordinates x of the variables."""
    own = {place.key: value for place, value in zip(places, x, strict=True)}
    if not any(key.startswith(f"log.{limb}.force.") for key in own for limb in limbs):
        return force
    one, none = jnp.ones_like(x[0]), jnp.zeros_like(x[0])
    offset = [[own.get(f"log.{limb}.force.zero.{axis}", none) for axis in "xyz"] for limb in limbs]
    gains = {limb: own.get(f"log.{limb}.force.gain", one) for limb in limbs}
    mixed = [
        [gains[limb] if a == b else own.get(f"log.{limb}.force.{b}_in_{a}", none) for a in "xyz" for b in "xyz"]
        for limb in limbs
    ]
    shares, zero = (jnp.stack([jnp.stack(row) for row in rows]) for rows in (mixed, offset))
    return jnp.matvec(shares.reshape(-1, 3, 3), force) + zero
