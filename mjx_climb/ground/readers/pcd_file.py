"""Point clouds of the Point Cloud Library (PCD 0.7): text, binary, or compressed by LZF.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import struct
from pathlib import Path

import numpy as np

from mjx_climb.ground.table import Table, packed
from mjx_climb.scenario.messages import ConfigError

SUFFIXES = (".pcd",)
_KINDS = {"F": "f", "I": "i", "U": "u"}


def read(path: Path, topic: str | None) -> Table:
    """The fields of the points by their names, without padding; of a field with several numbers the first one."""
    content, header, at = path.read_bytes(), dict[str, list[str]](), 0
    while "DATA" not in header:
        end = content.find(b"\n", at)
        if end < 0:
            raise ConfigError(str(path), "", "a header that ends with DATA", "none")
        words = content[at:end].decode("ascii", "replace").split("#")[0].split()
        header |= {words[0]: words[1:]} if words else {}
        at = end + 1

    def entry(key: str, number: int, default: list[str] | None = None) -> list[str]:
        words = header.get(key, default or [])
        if len(words) != number:
            raise ConfigError(str(path), key, f"{number} words", " ".join(words) or "none")
        return words

    def whole(key: str, number: int, default: list[str] | None = None) -> list[int]:
        words = entry(key, number, default)
        if not all(word.isdecimal() for word in words):
            raise ConfigError(str(path), key, "whole numbers, 0 or above", " ".join(words))
        return [int(word) for word in words]

    if not (names := header.get("FIELDS")):
        raise ConfigError(str(path), "FIELDS", "names", "none")
    (width,), (height,) = whole("WIDTH", 1, header.get("POINTS")), whole("HEIGHT", 1, ["1"])
    (count,), (kind,) = whole("POINTS", 1, [str(width * height)]), entry("DATA", 1)
    if count != width * height:
        raise ConfigError(str(path), "POINTS", f"WIDTH x HEIGHT, {width * height}", str(count))
    numbers, letters = whole("COUNT", len(names), ["1"] * len(names)), entry("TYPE", len(names))
    formats = [f"{letter}{size}" for letter, size in zip(letters, whole("SIZE", len(names)), strict=True)]
    if unknown := {*formats} - {"F4", "F8", *(f"{letter}{size}" for letter in "IU" for size in (1, 2, 4, 8))}:
        raise ConfigError(str(path), "TYPE and SIZE", "F of 4 or 8, I or U of 1, 2, 4 or 8", min(unknown))
    # names may stand twice; PCL names padding "_", several times, and without any number in it
    layout = [
        (str(place), f"<{_KINDS[each[0]]}{each[1:]}", (number,))
        for place, (each, number) in enumerate(zip(formats, numbers, strict=True))
    ]
    match kind:
        case "binary":
            points = packed(content, layout, count, at)
            values = [points[name] for name, *_ in layout]
        case "binary_compressed":
            if len(content) < at + 8:
                raise ValueError("no points")
            size, whole_size = struct.unpack_from("<II", content, at)
            fields = unpacked_lzf(content[at + 8 : at + 8 + size], whole_size)
            # field after field, each of all points
            each = packed(fields, [(name, form, (count, *shape)) for name, form, shape in layout], 1)[0]
            values = [each[name] for name, *_ in layout]
        case "ascii":
            rows = np.array(content[at:].split(), float)
            if rows.size != count * sum(numbers):
                expected = f"{count} points of {sum(numbers)} numbers"
                raise ConfigError(str(path), "POINTS", expected, f"{rows.size} numbers")
            values = np.split(rows.reshape(count, sum(numbers)), np.cumsum(numbers)[:-1], axis=1)
        case _:
            raise ConfigError(str(path), "DATA", "ascii, binary or binary_compressed", kind)
    viewpoint = np.array(entry("VIEWPOINT", 7, ["0"] * 7)[:3], float)
    if not np.isfinite(viewpoint).all():
        raise ConfigError(str(path), "VIEWPOINT", "finite numbers", " ".join(header["VIEWPOINT"]))
    return Table(
        str(path),
        [(name, value[:, 0]) for name, value in zip(names, values, strict=True) if name != "_" and value.shape[1]],
        # all zeros: programs that know of none write these
        viewpoint if viewpoint.any() else None,
    )


def unpacked_lzf(data: bytes, size: int) -> bytes:
    """Content compressed by LZF: literal runs, and copies from up to 8192 bytes before.

    Raises:
        ValueError: damaged content, or of another size.
    """
    out, at = bytearray(), 0
    try:
        while at < len(data):
            control = data[at]
            length, at = control >> 5, at + 1
            if not length:
                out += data[at : at + control + 1]
                at += control + 1
                continue
            if length == 7:
                length, at = length + data[at], at + 1
            begin, at, length = len(out) - ((control & 31) << 8) - data[at] - 1, at + 1, length + 2
            if begin < 0:
                raise IndexError
            piece = out[begin : begin + length]
            # a copy may reach into itself
            out += (piece * -(-length // len(piece)))[:length]
    except IndexError:
        raise ValueError("damaged compressed points") from None
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes of compressed points for {size}")
    return bytes(out)
