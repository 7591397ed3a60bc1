"""Point clouds of the Point Cloud Library (PCD 0.7), as text or binary, uncompressed.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

from pathlib import Path

import numpy as np

from mjx_climb.scenario.messages import config_error

SUFFIXES = (".pcd",)
_KINDS = {"F": "f", "I": "i", "U": "u"}


def read(path: Path, topic: str | None) -> dict[str, np.ndarray]:
    """The fields of the points by their names; of a field with several numbers the first one."""
    content, header = path.read_bytes(), dict[str, list[str]]()
    at = 0
    while "DATA" not in header:
        end = content.find(b"\n", at)
        if end < 0:
            raise config_error(str(path), "", "a header that ends with DATA", "none")
        words = content[at:end].decode("ascii", "replace").split("#")[0].split()
        header |= {words[0]: words[1:]} if words else {}
        at = end + 1
    names, counts = header["FIELDS"], header.get("COUNT", ["1"] * len(header["FIELDS"]))
    count, (kind,) = int(header["POINTS"][0]), header["DATA"]
    each = zip(header["TYPE"], header["SIZE"], counts, strict=True)
    formats = [(f"<{_KINDS[letter]}{size}", (int(numbers),)) for letter, size, numbers in each]
    if kind == "binary":
        # PCL names padding "_", several times
        unique = [f"{number} {name}" for number, name in enumerate(names)]
        layout = np.dtype([(name, *each) for name, each in zip(unique, formats, strict=True)])
        table = np.frombuffer(content, layout, count, at)
        first = [table[name][:, 0].astype(float) for name in unique]
    elif kind == "ascii":
        starts = np.cumsum([0, *map(int, counts)])[:-1]
        rows = np.array(content[at:].split(), float).reshape(count, sum(map(int, counts)))
        first = list(rows[:, starts].T)
    else:
        raise config_error(str(path), "DATA", "ascii or binary (pcl_convert_pcd_ascii_binary in.pcd out.pcd 1)", kind)
    return dict(zip(names, first, strict=True))
