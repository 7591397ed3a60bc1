"""Two hundred broken robot files: each is refused in one line that says where and which element, exit code 2."""

import re

import pytest

from tests.robot import climbers
from tests.robot.test_robot_file import urdf

MJCF = climbers.mjcf(4, 3).replace("><", ">\n<")
URDF = urdf(1)[0].replace("><", ">\n<")


def swap(old, new):
    """Return a change of the first line that an element's name stands in, and after it where it must come."""

    def change(lines, at):
        for n in range(at, len(lines)):
            if re.search(old, lines[n]):
                lines[n] = re.sub(old, new, lines[n], count=1)
                return
        raise AssertionError(old)

    return change


QUICK = ("L1_2", "RH_knee")

# what to change, from the line on in which the element stands
OF_JOINTS = {
    "an axis of no length": swap(r'axis="[^"]*"', 'axis="0 0 0"'),
    "an axis of two numbers": swap(r'axis="[^"]*"', 'axis="0 1"'),
    "a word for a number": swap(r'range="[^"]*"', 'range="low high"'),
    "limits the wrong way round": swap(r'range="[^"]*"', 'range="60 -60"'),
    "no such kind": swap(r'type="[^"]*"', 'type="cube"'),
    "an unknown key": swap(r'type="[^"]*"', 'kind="hinge"'),
    "a negative armature": swap(r'type="', 'armature="-1" type="'),
    "an element left open": swap(r"/>", ">"),
    "a weight below nothing": swap(r'mass="[^"]*"', 'mass="-0.2"'),
    "a weight in words": swap(r'mass="[^"]*"', 'mass="light"'),
    "half a weight": swap(r'mass="[^"]*"', ""),
    "moments below nothing": swap(r'diaginertia="[^"]*"', 'diaginertia="-1e-4 1e-4 1e-4"'),
    "no number": swap(r'mass="[^"]*"', 'mass="nan"'),
}
OF_LINKS = {
    "no parent": swap(r'parent link="[^"]*"', 'parent link="nobody"'),
    "no child": swap(r'child link="[^"]*"', 'child link="nobody"'),
    "an axis of no length": swap(r'axis xyz="[^"]*"', 'axis xyz="0 0 0"'),
    "a word in a place": swap(r'origin xyz="[^"]*"', 'origin xyz="here"'),
    "limits the wrong way round": swap(r'lower="[^"]*" upper="[^"]*"', 'lower="1" upper="-1"'),
    "limits in words": swap(r'lower="[^"]*"', 'lower="low"'),
    "no such kind": swap(r'type="[^"]*"', 'type="bendy"'),
    "an element left open": swap(r"/>", ">"),
}
BROKEN = {
    f"{name}, {what}": (suffix, text, name, change)
    for suffix, text, names, changes in (
        ("xml", MJCF, [f"L{limb}_{joint}" for limb in range(4) for joint in range(3)], OF_JOINTS),
        ("urdf", URDF, [f"{limb}_{joint}" for limb in ("LF", "RH") for joint in ("yaw", "lift", "knee")], OF_LINKS),
    )
    for name in names
    for what, change in changes.items()
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if element in QUICK else pytest.mark.slow)
        for name, (_, _, element, _) in BROKEN.items()
    ],
)
def test_a_broken_file_is_refused_in_one_line(saved, ended, name):
    """The line is that of the element or the one after, or names it."""
    suffix, text, element, change = BROKEN[name]
    lines = text.split("\n")
    at = next(n for n, line in enumerate(lines) if f'joint name="{element}"' in line)
    change(lines, at)
    file = saved("\n".join(lines), f"robot.{suffix}")
    code, out, line = ended(file)
    assert code == 2 and line.count("\n") == 1 and not out, (out, line)
    place = re.search(rf"{re.escape(str(file))}:(\d+)", line)
    assert place, line
    assert element in line or at <= int(place[1]) - 1 <= at + 8, line
