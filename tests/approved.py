"""Texts that were read and approved once: what a folder, a page and its pictures hold, in lines.

`APPROVE=1 pytest FILE` writes them anew; each changed line is then read, and its numbers are computed by hand.
"""

import json
import os
import re
from itertools import zip_longest
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.colors import to_hex

from tuning.pages.contents import Picture

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")
ROUGH = 4e-3  # relative, of numbers that other machines compute
SMALL = 2e-5  # absolute, of differences between walks in single precision
SETTINGS = ("search.yaml", "ensemble.yaml", "ceiling.yaml")  # whose texts are tested with the settings


def check(file: Path, text: str) -> None:
    """Assert that a text is the one that was approved."""
    if os.environ.get("APPROVE"):
        file.write_text(text)
    assert text == file.read_text()


def check_numbers(file: Path, text: str) -> None:
    """Assert that a text has the words of the approved one, and numbers that agree within rounding."""
    if os.environ.get("APPROVE"):
        file.write_text(text)
    lines = zip_longest(file.read_text().splitlines(), text.splitlines(), fillvalue="(no line)")
    differ = [f"- {known}\n+ {line}" for known, line in lines if not agree(known, line)]
    assert not differ, f"{file.name}: {len(differ)} lines differ\n" + "\n".join(differ[:40])


def agree(known: str, line: str) -> bool:
    """Return whether two lines have the same words, and numbers within `ROUGH`, `SMALL` or one unit of the last digit.

    The last digit of a number is rounded if it has three or more, a sign or a per cent behind it.
    """
    if known == line:
        return True
    if NUMBER.split(known) != NUMBER.split(line):
        return False
    pairs = zip(NUMBER.finditer(known), NUMBER.finditer(line), strict=True)
    return all(_near(one[0], other[0], known[one.end() :].lstrip().startswith("%")) for one, other in pairs)


def _near(one: str, other: str, share: bool) -> bool:
    if one == other:
        return True
    apart, unit = abs(float(one) - float(other)), min(_unit(one), _unit(other))
    digits = max(len(each.partition("e")[0].lstrip("+-0.").replace(".", "")) for each in (one, other))
    rounded = "." in one + other and (digits >= 3 or share or one[0] in "+-")
    return apart <= max(ROUGH * abs(float(one)), SMALL, 1.001 * unit if rounded else 0)


def _unit(number: str) -> float:
    digits, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))


def of_contents(contents, origin) -> str:
    """Return a folder's files, its summary and its page as lines."""
    lines = [f"again: {contents.again}"]
    for name, each in contents.files.items():
        if name != "summary.json":
            lines += [f"--- {name}", *([] if name in SETTINGS else of_file(name, each))]
    written = contents.written
    lines += ["--- summary", *of_json(json.loads(written.summary or "{}"))]
    lines += [f"--- shown: {table.caption}" for table in written.tables]
    page = None if contents.page is None else contents.page(origin)
    assert page is None or page.origin is origin
    if page is None or list(written.outcome) != page.findings.lines:
        lines += ["--- outcome", *written.outcome]
    return "\n".join([*lines, *([] if page is None else of_page(page)), ""])


def of_file(name, each) -> list[str]:
    """Return a text, a dataset or a picture as lines."""
    if isinstance(each, str):
        return of_json(json.loads(each)) if name.endswith(".json") else each.splitlines()
    if isinstance(each, xr.Dataset):
        sizes = ", ".join(f"{name} {size}" for name, size in each.sizes.items())
        return [f"dataset over {sizes}: {', '.join(map(str, each.data_vars))}"]
    assert isinstance(each, Picture)
    return [each.caption, *of_figure(each.draw())]


def of_page(page) -> list[str]:
    """Return the parts of a page as lines."""
    lines = [f"=== {page.title}", *page.findings.lines]
    lines += [f"main: {', '.join(page.main)}", *(f"{name}: {value}" for name, value in page.facts.items())]
    for heading, sentences in page.prose.items():
        lines += [heading, *sentences]
    for kind, tables in (("table", page.tables), ("opened", page.opened)):
        for table in tables:
            if kind == "opened" and table in page.tables:
                lines.append(f"opened: {table.caption}")
                continue
            lines += [f"{kind} ({table.words} words): {table.caption}", " | ".join(table.columns)]
            for heading, rows in table.sections:
                lines += [f"-- {heading}", *(" | ".join(row) for row in rows)]
    for heading, data in page.explorers.items():
        lines += [f"explorer {heading}", *of_json(data)]
    return lines


def of_json(value, before="") -> list[str]:
    """Return plain data with four digits, a line for all numbers of a mapping."""
    if isinstance(value, list) and any(isinstance(inner, dict) for inner in value):
        return [line for place, inner in enumerate(value) for line in of_json(inner, f"{before}.{place}")]
    if not isinstance(value, dict):
        return [f"{before.removeprefix('.')}: {_short(value)}"]
    nested = {key: inner for key, inner in value.items() if _nests(inner)}
    flat = ", ".join(f"{key} {_short(inner)}" for key, inner in value.items() if key not in nested)
    lines = [f"{before.removeprefix('.')}: {flat}"] if flat or not nested else []
    return lines + [line for key, inner in nested.items() for line in of_json(inner, f"{before}.{key}")]


def _nests(value) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and any(isinstance(inner, dict) for inner in value))


def of_figure(figure) -> list[str]:
    """Return panels, curves, marks and words of a picture; one panel where several look alike."""
    lines, known = [f"figure {_short(list(figure.get_size_inches()))} in"], []
    for axes in figure.axes:
        if not axes.get_visible():
            lines.append("  panel hidden")
            continue
        title = axes.get_title() or axes.get_title("left")
        about = f"{axes.get_xlabel()!r} {axes.get_xscale()}, {axes.get_ylabel()!r} {axes.get_yscale()}"
        drawn = of_panel(axes)
        lines.append(f"  panel {title!r}: {about}")
        lines += ["    as one above"] if drawn in known else drawn
        known.append(drawn)
    for legend in figure.legends:
        lines += _legend(legend)
    return lines


def of_panel(axes) -> list[str]:
    """Return the curves, marks and words of a panel."""
    lines = [f"    from and to {_short([*axes.get_xlim(), *axes.get_ylim()], 3)}"]
    for axis in (axes.xaxis, axes.yaxis):
        words = [text.get_text() for text in axis.get_ticklabels()]
        if any(word[:1].isalpha() for word in words):
            lines.append(f"    {axis.axis_name}: {', '.join(words)}")
    for line in axes.lines:
        look = f"{to_hex(line.get_color())} {line.get_linestyle()} {line.get_marker()} {line.get_linewidth():g}"
        size = f" {line.get_markersize():g} {line.get_markerfacecolor()}" if line.get_marker() != "None" else ""
        lines.append(f"    line {look}{size}: {_points(line.get_xdata())} | {_points(line.get_ydata())}")
    for patch in axes.patches:
        corners = patch.get_extents().transformed(axes.transData.inverted()).get_points()
        lines.append(f"    patch {to_hex(patch.get_facecolor())}: {_short(corners.ravel().tolist(), 3)}")
    lines += [f"    {type(each).__name__}" for each in (*axes.collections, *axes.images)]
    lines += [f"    text {text.get_text()!r}" for text in axes.texts]
    return lines + _legend(axes.get_legend())


def _legend(legend) -> list[str]:
    if legend is None:
        return []
    texts = [text.get_text() for text in legend.get_texts()]
    marks = [f"{to_hex(h.get_color())} {h.get_linestyle()} {h.get_marker()}" if hasattr(h, "get_marker")
             else to_hex(h.get_facecolor()) for h in legend.legend_handles]  # fmt: skip
    each = ", ".join(f"{text} ({mark})" for text, mark in zip(texts, marks, strict=True))
    return [f"  legend {legend.get_title().get_text()!r}: {each}"]


def _points(values) -> str:
    """Return numbers; of many the ends and the middle, their number and mean."""
    values = np.asarray(values, float).ravel()
    if values.size <= 12:
        return _short(values.tolist())
    some = _short(values[[0, values.size // 2, -1]].tolist())
    return f"{values.size} of {some}, mean {np.nanmean(values):.4g}"


def _short(value, digits=4) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{' '.join(_short(each, digits) for each in value)}]"
    if isinstance(value, float):
        return "0" if abs(value) < 1e-12 else f"{value:.{digits}g}"
    text = str(value)
    return text if " " in text or len(text) < 60 else f"{text[:40]}... of {len(text)}"
