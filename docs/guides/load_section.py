"""A section of a report: how the load of the feet is spread, of each walk beside the result."""

import numpy as np
from matplotlib.figure import Figure

from tuning.pages.section import Picture, Section, Table


def load(found, compared):
    """Return the mean load of each foot, and how often each load occurs."""
    if not hasattr(compared, "walks"):
        return None
    forces = {name: np.linalg.norm(walk.foot_force, axis=-1) for name, walk in compared.walks.items()}
    rows = [[name, *(f"{value:.3g}" for value in force.mean(0))] for name, force in forces.items()]
    limbs = [f"foot {number + 1}" for number in range(len(rows[0]) - 1)]

    def draw():
        figure = Figure(figsize=(3.5, 2.5), layout="constrained")
        axis = figure.subplots()
        axis.hist([force.ravel() for force in forces.values()], 20, label=list(forces))
        axis.set(xlabel="load of a foot [N]", ylabel="instants")
        axis.legend()
        return figure

    table = Table("Mean load, N", ["walk", *limbs], [("", rows)], 1)
    return Section("Load of the feet", tables=[table], pictures={"load": Picture("How often each load occurs.", draw)})
