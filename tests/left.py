"""What a command printed and left in its folder, as lines without times, versions and paths."""

import base64
import html
import json
import re
from pathlib import Path

import numpy as np
import xarray as xr
import yaml

from tests import approved

MASKS = {
    r"\b\d{4}-\d\d-\d\d[ T]\d\d:\d\d(:\d\d(\.\d+)?)?([+-]\d\d:\d\d|Z)?": "DATE",
    r"\b[0-9a-f]{40}(-dirty)?\b": "REVISION",
    r"(?<![\w.])(?=[0-9]*[a-f])[0-9a-f]{8,64}\b": "DIGEST",
    r"compilation cache: .*": "compilation cache: CACHE",
    r" (in|after) (\d+ min|[\d.]+ (s|ms|h))\b(?=: )": r" \1 TIME",
}
ROUNDING = 1e-9  # of the largest number: what is smaller is none
SINGLE = 2e-5  # likewise, of numbers in single precision
LONG = 300  # lines of a file, of which a few are compared
MANY = 1000  # flags, of which the share is compared
VERSIONS = re.compile(r"^.*(_version|_revision|_versions|versions)$|^(python|platform|device|git|host|cpu|made)$")
STAGE = re.compile(  # the time of a stage, and how far one has come
    r"^[^\n:]*: [\d.]+ (?:us|ms|s|min|h)(?:(?:,\s+of\s+which|\s+and)\s[\w\s.]*?(?:compiling|tracing|cache))*\s*\n"
    r"|^[^\n:]*: \d+ of \d+ [^\n]*\n|^[^\n:]*: cost [^\n]*\n|^[^\n]*\b\d+/\d+: [^\n]*\n|^ *\n",
    re.MULTILINE,
)


def of_command(code, out, err, folder: Path | None, *places: Path) -> str:
    """Return a command's end, its texts and all files of its folder as lines; `places` are masked."""
    lines = [f"exit {code}", "--- printed", *filter(str.strip, out.splitlines())]
    lines += ["--- said", *STAGE.sub("", err).splitlines()]
    if folder is not None:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                lines += [f"--- {file.relative_to(folder)}", *of_file(file, *places)]
    return masked("\n".join(line.rstrip() for line in lines) + "\n", *places)


def masked(text: str, *places: Path) -> str:
    """Return a text without paths, dates and digests."""
    for place in places:
        text = text.replace(str(place), "PLACE")
    for pattern, word in MASKS.items():
        text = re.sub(pattern, word, text)
    return text


def of_file(file: Path, *places: Path) -> list[str]:
    """Return a file's content as lines; of pictures of dots nothing."""
    kind = file.suffix
    if kind == ".nc":
        with xr.open_dataset(file) as data:
            return of_dataset(data, *places)
    if kind not in (".json", ".yaml", ".html", ".svg", ".csv", ".txt", ".md", ".hpp"):
        return []
    text = masked(file.read_text(), *places)
    if kind == ".json" or file.name == "config.yaml":
        return approved.of_json(unversioned(yaml.safe_load(text) if kind == ".yaml" else json.loads(text)))
    if kind == ".html":
        return of_page(text)
    lines = of_svg(text) if kind == ".svg" else text.splitlines()
    return lines if len(lines) <= LONG else lines[:: len(lines) // 30]


def unversioned(value):
    """Return plain data without the versions in it."""
    if isinstance(value, list):
        return [unversioned(each) for each in value]
    if not isinstance(value, dict):
        return value
    return {key: "VERSION" if VERSIONS.match(str(key)) else unversioned(each) for key, each in value.items()}


def of_dataset(data: xr.Dataset, *places: Path) -> list[str]:
    """Return the attributes of a dataset, and a line for each variable."""
    lines = []
    # gains.yaml has these, and a package without its repository no revision
    kept = {key: value for key, value in data.attrs.items() if key != "git_revision" and not str(value).startswith("{")}
    for key, value in unversioned(kept).items():
        first, *more = masked(str(value), *places).splitlines() or [""]
        lines.append(f"{key}: {first[:300]}" + (f" ({len(more)} lines more)" if more else ""))
    failed = data.get("diverged")
    for name, each in data.variables.items():
        if failed is not None and each.dims == failed.dims and each.dtype.kind == "f":
            each = each.where(~failed.variable.astype(bool))  # numbers of a walk that diverged are noise
        about = ", ".join(f"{key} {value}" for key, value in each.attrs.items())
        sizes = " ".join(f"{dim} {size}" for dim, size in each.sizes.items())
        lines.append(f"{name} ({sizes}) {each.dtype.kind}: {of_values(each.values)} {about}")
    return lines


def of_values(values) -> str:
    """Return numbers in five digits; of many three, their mean, and the mean of every other and of their sizes."""
    flat = np.asarray(values).ravel()
    if flat.dtype.kind == "b" and flat.size > MANY:
        return f"{flat.size}, {flat.mean():.5g} of them true"
    if flat.dtype.kind in "bUSO":
        words = [str(each) for each in flat]
        return " ".join(words) if len(words) <= 40 else f"{' '.join(words[:20])} ..., {len(set(words))} differ"
    rounding, flat = SINGLE if flat.dtype == np.float32 else ROUNDING, flat.astype(float)
    if flat.size <= 24:
        return approved._short(flat.tolist(), 5)
    finite = flat[np.isfinite(flat)]
    flat = np.where(np.abs(flat) < rounding * np.abs(finite).max(initial=0.0), 0.0, flat)
    some = approved._short(flat[[0, flat.size // 3, flat.size // 2, -1]].tolist(), 5)
    if finite.size == 0:
        return f"{flat.size} of {some}"
    means = np.array([finite.mean(), finite[::2].mean(), np.abs(finite).max()])
    means = np.where(np.abs(means) < rounding * means[2], 0.0, means).tolist()
    return f"{flat.size} of {some}, {flat.size - finite.size} not finite, {approved._short(means, 5)}"


def of_page(text: str) -> list[str]:
    """Return the words of a page, a line for each row of a table, and the data of its interactive parts."""
    data = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    text = re.sub(r"<(script|style|pre)\b.*?</\1>", "", text, flags=re.DOTALL) + _asked(text)
    text = re.sub(r'<img\b[^>]*alt="([^"]*)"[^>]*>', r"picture: \1", text)
    text = re.sub(r"(?<=</t[hd]>)\s*(?=<t[hd])", " | ", text)
    text = re.sub(r"<[^>]*>", "", text)
    lines = [html.unescape(line).strip() for line in text.splitlines()]
    lines = [_unversioned_row(line) for line in lines if line and not line.startswith("git revision | ")]
    return lines + (of_explorers(json.loads(data[1])) if data else [])


def _asked(text: str) -> str:
    """Return the commands of a page; its scenario stands in config.yaml too."""
    return "\n" + "\n".join(re.findall(r"<pre>(mjx-climb .*?)</pre>", text, re.DOTALL)) + "\n"


def _unversioned_row(line: str) -> str:
    name, bar, _ = line.partition(" | ")
    return f"{name} | VERSION" if bar and (VERSIONS.match(name) or name in ("versions", "MuJoCo", "JAX")) else line


def of_explorers(value, before="data") -> list[str]:
    """Return plain data, a line for each list of numbers."""
    if isinstance(value, dict):
        flat = {key: each for key, each in value.items() if not isinstance(each, (dict, list))}
        words = ", ".join(f"{key} {of_word(each)}" for key, each in flat.items())
        lines = [f"{before}: {words}"] if flat else []
        return lines + [
            line for key, each in value.items() if key not in flat for line in of_explorers(each, f"{before}.{key}")
        ]
    if isinstance(value, list):
        try:
            numbers = np.array(value, float)
        except (TypeError, ValueError):
            if all(not isinstance(each, (dict, list)) for each in value):
                return [f"{before}: " + of_values(np.array(value, object))]
            return [line for place, each in enumerate(value) for line in of_explorers(each, f"{before}.{place}")]
        return [f"{before} {' x '.join(map(str, numbers.shape))}: {of_values(numbers)}"]
    return [f"{before}: {approved._short(value, 5)}"]


def of_word(value) -> str:
    """Return a plain value; of a long one the numbers that it encodes, or its colours."""
    if not isinstance(value, str) or " " in value or len(value) < 200:
        return approved._short(value, 5)
    if re.fullmatch(r"[0-9a-f]*", value):
        colors = [f"#{value[start : start + 6]}" for start in range(0, len(value), 6)]
        return of_values(np.array(colors))
    return of_values(np.frombuffer(base64.b64decode(value), "<f4"))


def of_svg(text: str) -> list[str]:
    """Return the words of a picture and the number of its curves, patches and collections."""
    words = [html.unescape(word).strip() for word in re.findall(r"<!--(.*?)-->", text, re.DOTALL)]
    kinds = re.findall(r'<g id="([A-Za-z]+[A-Za-z]*?)_?\d*"', text)
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return [counts, " | ".join(words)]


def look_of(text: str) -> str:
    """Return the size of a picture, and the widths of its lines and sizes of its letters."""
    size = re.search(r'<svg [^>]*?height="([^"]*)"[^>]*?width="([^"]*)"|<svg ', text)
    widths = sorted(set(re.findall(r"stroke-width: ([\d.]+)", text)), key=float)
    letters = sorted(set(re.findall(r"scale\(([\d.]+)", text)), key=float)
    return f"{size.groups()}, lines {' '.join(widths)}, letters {' '.join(letters)}"
