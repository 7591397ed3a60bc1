"""What a foot's force sensor makes of the force on it: a share of it, an offset, and a share of another axis."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tuning.identification.variables import Variable

_AXES = "xyz"


def sensed(variables: Sequence[Variable], x: np.ndarray, values: dict[str, Any], tangents: dict[str, Any]) -> None:
    """Put what sensors say of the forces in the place of the forces (windows, steps, limb, 3), and of their tangents.

    The tangents (windows, P, steps, limb, 3) are along the variables, `log.LF.force.gain` among them.
    """
    own = [n for n, v in enumerate(variables) if v.key.startswith("log.") and ".force." in v.key and v.limb is not None]
    if not own:
        return
    force, limbs = values["force"], values["force"].shape[2]
    mixed, zero = np.tile(np.eye(3), (limbs, 1, 1)), np.zeros((limbs, 3))
    direct = np.zeros((len(own), *force.shape))
    for place, n in enumerate(own):
        limb, name = variables[n].limb, variables[n].key.split(".", 3)[3]
        if name == "gain":
            mixed[limb] += (x[n] - 1) * np.eye(3)
            direct[place][:, :, limb] = force[:, :, limb]
        elif name.startswith("zero"):
            axis = _AXES.index(name[-1])
            zero[limb, axis], direct[place][:, :, limb, axis] = x[n], 1.0
        else:
            source, axis = _AXES.index(name[0]), _AXES.index(name[-1])
            mixed[limb, axis, source] = x[n]
            direct[place][:, :, limb, axis] = force[:, :, limb, source]
    values["force"] = np.einsum("nij,wtnj->wtni", mixed, force) + zero
    tangents["force"] = np.einsum("nij,wptnj->wptni", mixed, tangents["force"])
    tangents["force"][:, own] += direct.swapaxes(0, 1)
