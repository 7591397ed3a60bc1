"""Draw how robot, law and loop hang together, and the layers of the code from the contracts in pyproject.toml.

python docs/images/drawings.py [FOLDER]
"""

import itertools
import sys
import tomllib
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Rectangle
from studies import COLOURS, FAINT, HERE, INK, WIDTH, save

ROOT = HERE.parents[1]
BLUE, ORANGE, GREEN, _ = COLOURS
Place = tuple[float, float]


def sheet(height: float) -> tuple[Figure, Axes]:
    """Return an empty sheet, 100 wide, and so high that both units are alike."""
    made = Figure(figsize=(WIDTH, WIDTH * height / 100), layout="none")
    panel = made.add_axes((0, 0, 1, 1))
    panel.set(xlim=(0, 100), ylim=(0, height))
    panel.axis("off")
    return made, panel


def box(panel: Axes, middle: Place, size: Place, text: str, colour: str = FAINT, font: float = 10.5) -> None:
    """Draw a frame with words in it."""
    corner = (middle[0] - size[0] / 2, middle[1] - size[1] / 2)
    frame = FancyBboxPatch(corner, *size, "round,pad=0,rounding_size=1.5", facecolor="none", edgecolor=colour, lw=1.5)
    panel.add_patch(frame)
    panel.text(*middle, text, ha="center", va="center", fontsize=font, linespacing=1.35)


def arrow(panel: Axes, *places: Place, text: str = "", at: Place = (0, 0), colour: str = INK) -> None:
    """Draw a line through some places that ends in a head, and words beside it."""
    for begin, end in itertools.pairwise(places[:-1]):
        panel.plot(*zip(begin, end, strict=True), color=colour, linewidth=1.5, solid_capstyle="round")
    how = {"arrowstyle": "-|>,head_width=0.25,head_length=0.5", "color": colour, "lw": 1.5, "shrinkA": 0, "shrinkB": 0}
    panel.annotate("", places[-1], places[-2], arrowprops=how)
    panel.text(*at, text, fontsize=9.5, va="center", color=colour)


def loop() -> Figure:
    """The gait's reference, shifted by the law, becomes joint targets; the forces on the feet go back to the law."""
    made, panel = sheet(128)
    box(panel, (27, 120), (50, 12), "gait\nbase path, footholds")
    box(panel, (27, 84), (50, 8), "inverse kinematics")
    box(panel, (27, 64), (50, 12), "bus and servos\npd: kp, kd")
    box(panel, (77, 102), (42, 17), "law, Eq. 3\nM ẍ + D ẋ + K x = -w", BLUE)
    box(panel, (77, 64), (42, 12), "force sensors\ndelay, noise", BLUE)
    panel.add_patch(Circle((27, 102), 3.6, facecolor="none", edgecolor=INK, lw=1.5))
    panel.text(27, 101.7, "+", ha="center", va="center", fontsize=13)
    arrow(panel, (27, 114), (27, 105.6), text="base reference", at=(29, 110))
    arrow(panel, (56, 102), (30.6, 102), text="shift x", at=(37, 105.2), colour=BLUE)
    arrow(panel, (27, 98.4), (27, 88), text="base target", at=(29, 94))
    arrow(panel, (27, 80), (27, 70), text="joint targets", at=(29, 75))
    arrow(panel, (77, 70), (77, 93.5), text="wrench w", at=(79, 82), colour=BLUE)
    _robot(panel)
    arrow(panel, (27, 58), (27, 45), text="torques", at=(29, 53))
    arrow(panel, (77, 22), (77, 58), text="forces", at=(79, 53), colour=BLUE)
    return made


def _robot(panel: Axes) -> None:
    """The robot from the side: base, limbs of two links with a gripper each, cargo, a push, forces on the feet."""
    panel.plot([2, 98], [8, 8], color=INK, linewidth=1.5)
    for x in range(3, 97, 5):
        panel.plot([x, x + 3], [4, 8], color=FAINT, linewidth=1)
    panel.add_patch(
        FancyBboxPatch((32, 34), 30, 8, "round,pad=0,rounding_size=1.5", facecolor=FAINT, edgecolor=INK, lw=1.5)
    )
    panel.text(47, 38, "base", ha="center", va="center", fontsize=10.5)
    panel.add_patch(Rectangle((40, 42), 14, 6, facecolor="none", edgecolor=ORANGE, lw=1.5))
    panel.text(47, 44.8, "cargo", ha="center", va="center", fontsize=9.5, color=ORANGE)
    for hip, knee, foot in (((34, 36), (22, 42), (17, 10)), ((40, 34), (34, 26), (33, 10)),
                            ((54, 34), (61, 27), (62, 10)), ((60, 36), (72, 42), (77, 10))):  # fmt: skip
        panel.plot(*zip(hip, knee, foot, strict=True), color=INK, linewidth=3, solid_joinstyle="round", zorder=1)
        panel.plot(*zip(hip, knee, strict=True), "o", color=INK, markersize=5)
        panel.plot([foot[0] - 3, foot[0] - 2, foot[0] + 2, foot[0] + 3], [8, 11, 11, 8], color=INK, linewidth=2)
        arrow(panel, (foot[0], 10), (foot[0], 21), colour=BLUE)
    arrow(panel, (20, 30.5), (32, 37.5), text="push", at=(9, 30), colour=ORANGE)


def layers() -> Figure:
    """The rooms of both packages from the top down: a room imports those below it, and tuning imports mjx_climb."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    rooms = {
        contract["name"].removeprefix("rooms of "): contract["layers"] for contract in contracts if "layers" in contract
    }
    step, height = 6.6, 152.0
    made, panel = sheet(height)
    for package, middle, colour in (("tuning", 25, ORANGE), ("mjx_climb", 75, BLUE)):
        panel.text(middle, height - 4, package, ha="center", va="center", fontsize=11, color=colour, weight="bold")
        top = height - 8
        for layer in rooms[package]:
            lines = _lines([name.split(".")[-1] for name in layer.split(" | ")])
            size = step - 1 + 4.4 * (len(lines) - 1)
            box(panel, (middle, top - size / 2), (46, size), "\n".join(lines), colour, 9)
            top -= size + 1
        if package == "tuning":
            panel.text(middle, top - 7, "each imports\nthose below it", ha="center", va="center", fontsize=10)
            arrow(panel, (middle, top - 14), (middle, top - 22), (50.5, top - 22), colour=ORANGE)
            panel.text(
                middle, top - 27, "tuning imports\nmjx_climb, never\nthe reverse", ha="center", va="top", fontsize=10
            )
    return made


def _lines(names: list[str], width: int = 24) -> list[str]:
    """Return names side by side in as many lines as they need."""
    lines = names[:1]
    for name in names[1:]:
        if len(lines[-1]) + len(name) + 3 <= width:
            lines[-1] += f" | {name}"
        else:
            lines.append(name)
    return lines


PICTURES = {"loop": loop, "layers": layers}


if __name__ == "__main__":
    save(PICTURES, *map(Path, sys.argv[1:]))
