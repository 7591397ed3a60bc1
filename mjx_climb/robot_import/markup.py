"""A robot's file as text: its elements, their lines, and the parts of a URDF that the dynamics need."""

import contextlib
import math
import os
import re
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

from mjx_climb.robot.constants import RobotError

LARGEST, FARTHEST = 1e9, 1e4  # of a number, in any unit of a robot's file; of a place, m
_INCLUDE = re.compile(r"<include\s[^>]*?file\s*=\s*[\"']([^\"']+)[\"'][^>]*?(?:/>|>\s*</include\s*>)")
_ROOT = re.compile(r"<\?.*?\?>|</?\s*mujoco(?:include)?\b[^>]*>")
_TAG = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>")
_NUMBERS = frozenset(
    "xyz rpy value ixx ixy ixz iyy iyz izz radius length size scale damping friction multiplier offset pos quat "
    "axisangle euler xyaxes zaxis fromto mass density diaginertia fullinertia axis ref springref springdamper armature "
    "stiffness frictionloss gear gainprm biasprm kp kv qpos polycoef".split()
)
_LIMITS = frozenset("lower upper effort velocity range forcerange ctrlrange actfrcrange".split())  # huge: none
_FLOATING = ("floating", "planar")
# the URDF's elements that stay; MuJoCo refuses some of the others, such as a second <material/>
_KEPT = {
    "robot": {"link", "joint", "mujoco"},
    "link": {"inertial", "visual", "collision"},
    "visual": {"origin", "geometry"},
    "collision": {"origin", "geometry"},
    "joint": {"origin", "parent", "child", "axis", "limit", "mimic", "dynamics"},
}


class Element(NamedTuple):
    """An element of a file."""

    tag: str
    attributes: dict[str, str]
    line: int
    parent: int  # place of the element around it in the list of all, -1 of the outermost
    begin: int  # bytes
    end: int


def elements(text: str) -> list[Element]:
    """Return the elements of a text, in its order; none where it is no XML."""
    data, found, opened = text.encode(), list[Element](), list[int]()
    parser = expat.ParserCreate("utf-8")

    def begun(tag: str, attributes: dict[str, str]) -> None:
        parent, at = opened[-1] if opened else -1, parser.CurrentByteIndex
        opened.append(len(found))
        start_tag = _TAG.match(data, at)
        end = start_tag.end() if start_tag and start_tag[0].endswith(b"/>") else 0
        found.append(Element(tag, attributes, parser.CurrentLineNumber, parent, at, end))

    def ended(_: str) -> None:
        place = opened.pop()
        if not found[place].end:
            found[place] = found[place]._replace(end=data.index(b">", parser.CurrentByteIndex) + 1)

    parser.StartElementHandler, parser.EndElementHandler = begun, ended
    try:
        parser.Parse(data, True)
    except expat.ExpatError:
        return []
    return found


def text_of(file: str) -> str:
    """Return a file without comments, their lines kept; nothing of one that cannot be read."""
    try:
        text = Path(file).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return re.sub(r"<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text, flags=re.DOTALL)


def is_urdf(file: str) -> bool:
    """Return whether a file is a URDF, by its outermost element; MuJoCo goes by that too, not by the file's name."""
    outermost = re.search(r"<\s*([\w:]+)", re.sub(r"<[?!].*?>", "", text_of(file), flags=re.DOTALL))
    return outermost is not None and outermost[1] == "robot"


def needed(text: str) -> str:
    """A URDF without the parts that the dynamics do not need, line by line; as it is where it is no XML.

    A joint that floats, or slides and turns on a plane, begins a robot of its own: MuJoCo has it hang on the world. One
    that is continuous has no limits.
    """
    data, found = bytearray(text.encode()), elements(text)
    kinds = {n: each.attributes.get("type") for n, each in enumerate(found) if each.tag == "joint"}
    floating = {n for n, kind in kinds.items() if kind in _FLOATING}
    for each in reversed(found):  # from the end, so that places before stay
        span = slice(each.begin, each.end)
        if each.parent >= 0 and each.tag not in _KEPT.get(found[each.parent].tag, {each.tag}):
            data[span] = re.sub(rb"[^\n]", b" ", data[span])
        elif each.tag == "parent" and each.parent in floating:
            data[span] = b'<parent link="world"/>' + b"\n" * data[span].count(b"\n")
        elif each.tag == "limit" and kinds.get(each.parent) == "continuous":
            data[span] = re.sub(rb"\b(lower|upper)(\s*=\s*)(\"[^\"]*\"|'[^']*')", b"", data[span])
    text = data.decode()
    if floating and not any(each.tag == "link" and each.attributes.get("name") == "world" for each in found):
        text = re.sub(r"</robot\s*>", '<link name="world"/></robot>', text)
    return re.sub(r"(<joint\b[^>]*\btype\s*=\s*[\"'])planar\b", r"\1floating", text)


def urdf_limits(file: str, attribute: str) -> dict[str, float]:
    """Return an attribute of the limits of a URDF's joints, by joint, where it is a number; nothing of an MJCF."""
    found = elements(needed(text_of(file))) if is_urdf(file) else []
    given = {}
    for each in found:
        joint = found[each.parent]
        if each.tag == "limit" and joint.tag == "joint" and attribute in each.attributes:
            with contextlib.suppress(ValueError):
                given[joint.attributes.get("name", "")] = float(each.attributes[attribute])
    return given


def fixed_by_limits(file: str) -> dict[str, float]:
    """Return the joints of a URDF whose two limits are one value, and that value; MuJoCo takes 0 and 0 for no limits.

    None where all joints are so: some exporters write 0 where nobody gave a limit.
    """
    lower, upper = (urdf_limits(file, key) for key in ("lower", "upper"))
    both = {name: value for name, value in lower.items() if name in upper}
    fixed = {name: value for name, value in both.items() if upper[name] == value}
    return fixed if len(fixed) < len(both) else {}


def check_numbers(file: str) -> None:
    """Refuse numbers of a file that are none, or so large that no robot has them.

    Raises:
        RobotError: in one line, the place, the element, the expected and the found.
    """
    lines = lines_of(Path(file))
    found = elements("\n".join(text for _, text in lines))
    for each in found:
        for key, token in ((key, token) for key, text in each.attributes.items() for token in text.split()):
            if key not in _NUMBERS | _LIMITS:
                continue
            try:
                number = float(token)
            except ValueError:  # MuJoCo says so
                continue
            most = FARTHEST if key in ("xyz", "pos") else math.inf if key in _LIMITS else LARGEST
            if math.isnan(number) or abs(number) > most:
                around = [each]  # from the inside out
                while around[-1].parent >= 0:
                    around.append(found[around[-1].parent])
                named = next((e for e in around if e.attributes.get("name")), each)
                of = f"{named.tag} {named.attributes.get('name', '')!r}: {each.tag} {key}"
                place = lines[each.line - 1][0]
                raise RobotError(f"{place}: {of}: expected numbers of up to {most:g}, got {token}")


def check_names(file: str) -> None:
    """Refuse a URDF with two links of one name, or two joints.

    Raises:
        RobotError: in one line, the place of the second.
    """
    lines = lines_of(Path(file))
    found = elements("\n".join(text for _, text in lines)) if is_urdf(file) else []
    seen: dict[tuple[str, str], int] = {}
    for each in found:
        name = (each.tag, each.attributes.get("name", ""))
        if each.tag in ("link", "joint") and each.parent == 0 and seen.setdefault(name, each.line) != each.line:
            expected = f"one {each.tag} {name[1]!r}"
            raise RobotError(f"{lines[each.line - 1][0]}: expected {expected}, got another in line {seen[name]}")


# ------------------------------------------------------------------------------------------------------------
# Where something stands in a file


def lines_of(file: Path, around: tuple[Path, ...] = ()) -> list[tuple[str, str]]:
    """Return the lines of a file, and of those that it includes in their places: each line's file:number, and text."""
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return []
    found = []
    for number, line in enumerate(text.split("\n"), 1):
        for n, part in enumerate(_INCLUDE.split(line)):  # text, file, text, and so on
            if n % 2 == 0:
                found.append((f"{file}:{number}", _ROOT.sub("", part) if around else part))
            # one path for a file, so that a circle by way of ".." ends
            elif (other := Path(os.path.normpath(file.parent / part))) not in (*around, file):
                found += lines_of(other, (*around, file))
    return found


def line_of(file: str, name: str) -> str:
    """A file, a colon and the line where it, or a file that it includes, first names an element so.

    Or else the first line with the name in quotes.
    """
    quoted = rf"[\"']{re.escape(name)}[\"'])"
    element = rf"<\s*(?:body|joint|freejoint|link|geom|site)\s[^<>]*?(name\s*=\s*{quoted}"
    lines = lines_of(Path(file))
    text = "\n".join(line for _, line in lines)
    searches = (re.search(pattern, text, re.DOTALL) for pattern in (element, rf"(name\s*=\s*{quoted}", f"({quoted}"))
    found = next(filter(None, searches), None)
    return file if found is None else lines[text.count("\n", 0, found.start(found.lastindex or 0))][0]
