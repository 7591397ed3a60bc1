"""Words and scales on pictures: controller, case, time, forces, a legend, and the largest foot force over time."""

import functools
import io
import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from mjx_climb.scenario.model import Scenario
from mjx_climb.trajectory import Trajectory
from mjx_climb.viz.plots.events import detachments, disturbances, failure_time, largest_foot_force, row_at, thin, whole
from mjx_climb.viz.rendering import marks
from mjx_climb.viz.rendering.canvas import MICROGRAVITY, View

BEYOND = 1e4  # N
NO_FORCE = "no force on any foot"
WHITE, DIM, DARK, ALARM = "#FFFFFF", "#CDD0D4", "#101216A8", "#FF786E"
GROUND, SHADE, OTHERS, OWN = "#16191E", "#2C323C", "#767C84", "#78BEFF"  # of a trace of forces


@functools.cache
def font(pixels: float, bold: bool = False) -> ImageFont.FreeTypeFont:
    """Return a font of a height, in pixels: the one that comes with matplotlib."""
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, round(pixels))


def controller(trajectory: Trajectory) -> str:
    """Return the name of the control law of a walk."""
    if trajectory.law:
        return trajectory.law
    control = trajectory.scenario.control
    name = control.controller.replace("end_effector", "end-effector").replace("_", " ")
    return name if control.reading == "virtual_model" else f"{name}, measured pose"


def case(scenario: Scenario) -> str:
    """Return gravity, slope and disturbances of a scenario in a line."""
    strength = math.hypot(*scenario.gravity)
    parts = ["microgravity" if strength < MICROGRAVITY else f"gravity {strength:.3g} m/s²"]
    if strength >= MICROGRAVITY:
        slope = math.degrees(math.acos(max(-1.0, min(1.0, -scenario.gravity[2] / strength))))
        parts += [f"slope {slope:.0f}°"] * (slope >= 0.5)
    cargo, pushes = scenario.disturbance.cargo, scenario.disturbance.pushes
    if cargo.mass and cargo.start < scenario.duration:
        parts.append(f"cargo {cargo.mass:g} kg from {cargo.start:g} s")
    if pushes:
        parts.append(f"{len(pushes)} push" + "es" * (len(pushes) > 1))
    return ", ".join(parts)


def newtons(value: float) -> str:
    """Return the size of a force in words."""
    if value > BEYOND:  # the walk has long failed: no number tells more
        return f"over {BEYOND / 1e3:g} kN"
    return f"{value:.1f} N" if value < 1000 else f"{value / 1e3:.1f} kN"


class Caption:
    """Captions over the pictures of one walk; an arrow of 1 N is `scale` m long there."""

    def __init__(self, trajectory: Trajectory, label: str, size: tuple[int, int], scale: float):
        self._walk, self._label, self._size, self._scale = trajectory, label, size, scale
        self._unit = max(min(size[1] / 36, size[0] / 56), 7.0)  # pixels, the height of a line of text
        self._forces = np.linalg.norm(trajectory.foot_force[: whole(trajectory)], axis=-1)
        self._torn = detachments(trajectory)

    def draw(self, picture: np.ndarray, row: int, view: View, pixels_per_meter: float | None) -> np.ndarray:
        """Return the picture (H, W, 3) of a row with everything on it; with a legend where pixels per meter are known.

        They hold at the distance of the camera's target.
        """
        image, unit, line = Image.fromarray(picture), self._unit, case(self._walk.scenario)
        draw = ImageDraw.Draw(image, "RGBA")
        title, text = font(1.25 * unit, bold=True), font(0.9 * unit)
        width = max(title.getlength(self._label), text.getlength(line)) + 1.2 * unit
        self._box(draw, 0.7 * unit, 0.7 * unit, width, 3.4 * unit)
        draw.text((1.3 * unit, 1.0 * unit), self._label, WHITE, title)
        draw.text((1.3 * unit, 2.7 * unit), line, DIM, text)
        self._state(draw, row)
        if pixels_per_meter is not None:
            self._legend(draw, self._scale * pixels_per_meter)
        if np.linalg.norm(view.gravity) >= MICROGRAVITY:  # an arrow: gravity's direction in the picture's plane
            right, up, _ = view.axes()
            way = np.array([view.gravity @ right, -(view.gravity @ up)])
            way /= max(np.linalg.norm(way), 1e-9)
            center, side = np.array([self._size[0] - 2.2 * unit, 2.9 * unit]), np.array([-way[1], way[0]])
            self._box(draw, center[0] - 1.5 * unit, center[1] - 2.2 * unit, 3.0 * unit, 4.4 * unit)
            end = center + 1.6 * unit * way
            draw.line((*(center - 1.6 * unit * way), *(end - 0.6 * unit * way)), WHITE, max(round(0.2 * unit), 2))
            tip = [end, *(end - 0.9 * unit * way + across * unit * side for across in (0.45, -0.45))]
            draw.polygon([tuple(corner) for corner in tip], WHITE)
            draw.text(tuple(center + 0.75 * unit * side), "g", WHITE, font(unit, bold=True), anchor="mm")
        return np.array(image)

    def _box(self, draw: ImageDraw.ImageDraw, left: float, top: float, width: float, height: float) -> None:
        corners = (left, top, left + width, top + height)  # whole pixels: the corners' quarters would overlap
        draw.rounded_rectangle([round(place) for place in corners], round(0.4 * self._unit), fill=DARK)

    def _state(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        """Write time, forces and failures at the bottom left."""
        walk, unit, plain, bold = self._walk, self._unit, font(self._unit), font(self._unit, bold=True)
        limb = int(self._forces[row].argmax())
        now, peak = self._forces[row, limb], self._forces[: row + 1].max()
        lines = [
            (f"t = {walk.time[row]:.2f} s", WHITE, font(1.25 * unit, bold=True)),
            (f"largest force {newtons(now)} at {walk.limbs[limb]}" if now >= 0.05 else NO_FORCE, WHITE, plain),
            (f"largest so far {newtons(peak)}", DIM, plain),
        ]
        if push := float(np.linalg.norm(walk.push[row, :3])):
            lines.append((f"push {newtons(push)}", to_hex(marks.PUSH), bold))
        if torn := [name for time, name in self._torn if time <= walk.time[row]]:
            lines.append((f"{', '.join(torn)} torn off", ALARM, bold))
        if row == len(self._forces) - 1 < walk.time.size - 1:
            lines.append(("diverged", ALARM, bold))
        step = 1.45 * unit
        top = self._size[1] - 1.1 * unit - step * len(lines) - 0.4 * unit
        self._box(draw, 0.7 * unit, top, 16.5 * unit, step * len(lines) + 0.6 * unit)
        for number, (words, fill, letters) in enumerate(lines):
            draw.text((1.3 * unit, top + 0.3 * unit + number * step), words, fill, letters)

    def _legend(self, draw: ImageDraw.ImageDraw, pixels_per_newton: float) -> None:
        """Draw the key of the arrows' colours and lengths at the bottom right."""
        unit, text, limit = self._unit, font(0.85 * self._unit), self._walk.scenario.value("contact.holding_limit")
        pulled = f"pulled, share of {limit:g} N" if limit else "foot force, pulled"
        entries = {"foot force, pressed": marks.PRESSED, pulled: marks.pulled(0.5)}
        if self._walk.scenario.disturbance.pushes:
            entries["push on the base"] = marks.PUSH
        width, height = 15.5 * unit, (1.5 * (len(entries) + (1.1 if limit else 0) + 1) + 0.8) * unit
        left, top = self._size[0] - width - 0.7 * unit, self._size[1] - height - 0.7 * unit
        self._box(draw, left, top, width, height)
        x, y = left + 0.7 * unit, top + 0.55 * unit
        for words, rgb in entries.items():
            middle, tip, head, fill = y + 0.6 * unit, x + 2.2 * unit, x + 1.32 * unit, to_hex(rgb)
            draw.line((x, middle, x + 1.43 * unit, middle), fill, max(round(0.32 * unit), 2))
            draw.polygon([(tip, middle), (head, middle - 0.45 * unit), (head, middle + 0.45 * unit)], fill)
            draw.text((tip + 0.6 * unit, y), words, WHITE, text)
            y += 1.5 * unit
            if limit and words == pulled:
                bar = round(width - 1.4 * unit)
                for pixel in range(bar):
                    draw.line((x + pixel, y, x + pixel, y + 0.55 * unit), to_hex(marks.pulled(pixel / bar)))
                for share, anchor in ((0.0, "lt"), (0.5, "mt"), (1.0, "rt")):
                    draw.text((x + share * bar, y + 0.7 * unit), f"{100 * share:.0f} %", DIM, text, anchor=anchor)
                y += 1.65 * unit
        most = 0.55 * width / pixels_per_newton  # N, of the scale: it is 1, 2 or 5 times a power of ten
        power = 10.0 ** math.floor(math.log10(most))
        force = next(step * power for step in (5, 2, 1) if step * power <= most * (1 + 1e-9))
        end, middle = x + force * pixels_per_newton, y + 0.7 * unit
        for line in ((x, middle, end, middle), (x, middle - 4, x, middle + 4), (end, middle - 4, end, middle + 4)):
            draw.line(line, WHITE, max(round(0.12 * unit), 1))
        draw.text((end + 0.6 * unit, y + 0.1 * unit), f"{force:g} N", WHITE, text)


class ForceTrace:
    """The largest foot force of one walk over time, that of the walks beside it in grey, and a line that moves on."""

    def __init__(self, trajectories: Sequence[Trajectory], number: int, size: tuple[int, int]):
        lines, limits = [], []  # of every walk up to where its state stops being finite
        for walk in trajectories:
            rows = whole(walk)
            time, forces = walk.time[:rows], largest_foot_force(walk)[:rows]
            lines.append(thin(time, forces))
            # at most three times the largest force before a failure
            limits.append(min(forces.max(), 3 * forces[time <= failure_time(walk)].max(initial=0.0) or np.inf))
        self._walk, self._size, self._unit = trajectories[number], size, max(size[1] / 6, 7.0)  # pixels, a line of text
        self._forces, highest = largest_foot_force(self._walk), max(*limits, 1e-9 / 1.08)
        self._top = 1.08 * highest
        (width, height), unit, left = size, self._unit, 3.1 * self._unit
        figure = Figure(figsize=(width / 72, height / 72), dpi=72, facecolor=GROUND)  # a point is a pixel
        frame = (left / width, 0.5 * unit / height, (width - 1.3 * left) / width, 1 - 1.9 * unit / height)
        self._panel = figure.add_axes(frame, frame_on=False, xticks=[], ylim=(0, self._top))
        self._panel.set_xlim(0, max(*(float(walk.time[-1]) for walk in trajectories), 1e-9))
        for start, stop, *_ in disturbances(self._walk):
            self._panel.axvspan(start, stop, color=SHADE, linewidth=0)
        for other, (time, forces) in sorted(enumerate(lines), key=lambda line: line[0] == number):
            color = OWN if other == number else OTHERS
            self._panel.plot(time, np.minimum(forces, self._top), color=color, linewidth=0.1 * unit, clip_on=False)
        self._panel.set_yticks([0, highest], ["0", f"{highest:.2g} N"], color=DIM, fontsize=0.85 * unit)
        self._panel.tick_params(length=0, pad=0.35 * unit)
        words = "largest foot force" + (", the other walk's in grey" if len(lines) > 1 else "")
        figure.text(frame[0], 1 - 0.2 * unit / height, words, va="top", color=DIM, fontsize=0.85 * unit)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="rgba", dpi=72)
        self._picture = np.frombuffer(buffer.getvalue(), np.uint8).reshape(height, width, 4)[..., :3]

    def at(self, time: float) -> np.ndarray:
        """Return the strip (H, W, 3) at a time, s."""
        row = row_at(self._walk, time)
        force = np.nan_to_num(self._forces[row], nan=np.inf).clip(max=self._top)
        x, y = self._panel.transData.transform((self._walk.time[row], force))
        y, reach = self._size[1] - y, 0.22 * self._unit
        picture = Image.fromarray(self._picture)
        draw = ImageDraw.Draw(picture)
        draw.line((x, 0, x, self._size[1]), WHITE, max(round(self._unit / 14), 1))
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), OWN, WHITE)
        return np.asarray(picture)
