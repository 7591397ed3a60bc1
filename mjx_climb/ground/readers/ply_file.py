"""Point clouds and meshes as PLY, by `trimesh`: the properties of their vertices."""

from pathlib import Path

import numpy as np

SUFFIXES = (".ply",)


def read(path: Path, topic: str | None) -> dict[str, np.ndarray]:
    """The properties of the vertices by their names, with normals `nx`, `ny`, `nz` of a mesh that has none."""
    import trimesh

    loaded = trimesh.load(path, process=False)
    # trimesh itself keeps colours and normals alone of what a vertex has
    vertex = loaded.metadata["_ply_raw"]["vertex"]
    columns = {name: np.asarray(vertex["data"][name], float).reshape(-1) for name in vertex["properties"]}
    if isinstance(loaded, trimesh.Trimesh) and "nx" not in columns:
        columns |= zip(("nx", "ny", "nz"), loaded.vertex_normals.T, strict=True)
    return columns
