"""Point clouds and meshes as PLY: the properties of their vertices, and normals of meshes by `trimesh`.

Format: http://paulbourke.net/dataformats/ply
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjx_climb.ground.table import Column, Table, packed
from mjx_climb.scenario.messages import ConfigError

SUFFIXES = (".ply",)
_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"},
    **{"double": "f8", "float64": "f8"},
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    name: str
    number: int
    properties: list[tuple[str, str]]  # names and types; "" for a list

    def layout(self, order: str) -> np.dtype:
        """One of them in binary; of a list the one byte that it has at least."""
        kinds = [f"{order}{_TYPES[kind]}" if kind else "u1" for _, kind in self.properties]
        return np.dtype([(str(place), kind) for place, kind in enumerate(kinds)])


def read(path: Path, topic: str | None) -> Table:
    """The properties of the vertices by their names, with normals `nx`, `ny`, `nz` of a mesh that has none."""
    head, end, data = path.read_bytes().partition(b"end_header")
    if not (head.startswith(b"ply") and end):
        raise ValueError("no header from ply to end_header")
    order, elements = _header(str(path), head.decode("ascii", "replace").splitlines())
    names = [each.name for each in elements]
    place = names.index("vertex") if names.count("vertex") == 1 else -1
    if place < 0 or any(not kind for each in elements[: place + 1] for _, kind in each.properties):
        expected = "one element vertex, and lists in none before its end"
        raise ConfigError(str(path), "header", expected, ", ".join(names) or "none")
    vertex, data = elements[place], data.partition(b"\n")[2]
    # as text each element is a line
    content = data if order else [line for line in data.splitlines() if line.strip()]
    sizes = [each.number * (each.layout(order).itemsize if order else 1) for each in elements]
    longer = order and any(not kind for each in elements for _, kind in each.properties)
    if not (len(content) == sum(sizes) or (longer and len(content) > sum(sizes))):
        expected = f"{sum(sizes)} {'bytes' if order else 'lines'} for {vertex.number} vertices and the other elements"
        raise ConfigError(str(path), "element", expected, str(len(content)))
    start = sum(sizes[:place])
    of_vertices = content[start : start + sizes[place]]
    columns: list[Column]
    if isinstance(of_vertices, bytes):
        records = packed(of_vertices, vertex.layout(order), vertex.number)
        columns = [(name, records[str(number)]) for number, (name, _) in enumerate(vertex.properties)]
    else:
        rows = np.array([line.split() for line in of_vertices], float).reshape(vertex.number, len(vertex.properties))
        columns = [(name, column) for (name, _), column in zip(vertex.properties, rows.T, strict=True)]
    if "nx" not in dict(columns) and any(each.name == "face" and each.number for each in elements):
        import trimesh

        mesh = trimesh.load(path, process=False, fix_texture=False, skip_materials=True)
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.vertices) != vertex.number:
            raise ConfigError(str(path), "face", "faces of the vertices", "damaged ones")
        columns += zip(("nx", "ny", "nz"), mesh.vertex_normals.T, strict=True)
    return Table(str(path), columns)


def _header(file: str, lines: list[str]) -> tuple[str, list[_Element]]:
    """The order of bytes, "" for text, and the elements."""
    form, elements = "none", list[_Element]()
    for words in map(str.split, lines):
        match words:
            case [] | ["ply"] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, _]:
                form = name
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].properties.append((name, kind))
            case ["property", "list", _, _, name] if elements:
                elements[-1].properties.append((name, ""))
            case _:
                raise ConfigError(file, "header", "format, element and property", " ".join(words))
    if form not in _ORDERS:
        raise ConfigError(file, "format", ", ".join(_ORDERS), form)
    return _ORDERS[form], elements
