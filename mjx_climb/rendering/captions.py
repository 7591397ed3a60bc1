"""Words and scales over a picture: controller, case, time, forces, and a legend."""

import math
from collections.abc import Iterable

import numpy as np
from PIL import Image, ImageDraw

from mjx_climb.plots.walk_events import detachments
from mjx_climb.rendering import marks
from mjx_climb.rendering.camera import MICROGRAVITY, View
from mjx_climb.rendering.lettering import font
from mjx_climb.rendering.replay import whole
from mjx_climb.rollouts.trajectory import Trajectory
from mjx_climb.scenario.model import Scenario

BEYOND = 1e4  # N
WHITE, DIM, DARK, ALARM = (255, 255, 255), (205, 208, 212), (16, 18, 22, 168), (255, 120, 110)
LAWS = {
    "pd": "pd",
    "base_admittance": "base admittance",
    "end_effector_admittance": "end-effector admittance",
}


def controller(trajectory: Trajectory) -> str:
    """Return the name of the control law of a walk."""
    if trajectory.law:
        return trajectory.law
    scenario = trajectory.scenario
    name = LAWS[scenario.control.controller]
    return name if scenario.control.reading == "virtual_model" else f"{name}, measured pose"


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


class Caption:
    """Draws over the pictures of one walk."""

    def __init__(self, trajectory: Trajectory, label: str, size: tuple[int, int], scale: float, legend: bool):
        self._trajectory, self._size, self._legend = trajectory, size, legend
        self._unit = max(min(size[1] / 36, size[0] / 56), 7.0)  # pixels, the height of a line of text
        self._scale = scale
        self._forces = np.linalg.norm(trajectory.foot_force[: whole(trajectory)], axis=-1)
        self._torn = detachments(trajectory)
        self._label = label

    def draw(self, picture: np.ndarray, row: int, view: View, pixels_per_meter: float) -> np.ndarray:
        """Return the picture (H, W, 3) with everything on it.

        Arguments:
            row: of the trajectory, shown in the picture.
            view: of the picture.
            pixels_per_meter: at the distance of what the camera looks at.
        """
        image = Image.fromarray(picture)
        draw = ImageDraw.Draw(image, "RGBA")
        self._heading(draw)
        self._state(draw, row)
        if self._legend:
            self._explain(draw, pixels_per_meter)
        self._down(draw, view)
        return np.array(image)

    def _box(self, draw: ImageDraw.ImageDraw, left: float, top: float, width: float, height: float) -> None:
        corners = (left, top, left + width, top + height)  # whole pixels: the corners' quarters would overlap
        draw.rounded_rectangle([round(place) for place in corners], round(0.4 * self._unit), fill=DARK)

    def _heading(self, draw: ImageDraw.ImageDraw) -> None:
        unit = self._unit
        title, text = font(round(1.25 * unit), bold=True), font(round(0.9 * unit))
        line = case(self._trajectory.scenario)
        width = max(title.getlength(self._label), text.getlength(line)) + 1.2 * unit
        self._box(draw, 0.7 * unit, 0.7 * unit, width, 3.4 * unit)
        draw.text((1.3 * unit, 1.0 * unit), self._label, WHITE, title)
        draw.text((1.3 * unit, 2.7 * unit), line, DIM, text)

    def _state(self, draw: ImageDraw.ImageDraw, row: int) -> None:
        trajectory, unit = self._trajectory, self._unit
        limb = int(self._forces[row].argmax())
        now, peak = self._forces[row, limb], self._forces[: row + 1].max()
        lines = [
            (f"t = {trajectory.time[row]:.2f} s", WHITE, font(round(1.25 * unit), bold=True)),
            (
                f"largest force {newtons(now)} at {trajectory.limbs[limb]}" if now >= 0.05 else "no force on any foot",
                WHITE,
                font(round(unit)),
            ),
            (f"largest so far {newtons(peak)}", DIM, font(round(unit))),
        ]
        push = float(np.linalg.norm(trajectory.push[row, :3]))
        if push:
            red, green, blue = (int(255 * channel) for channel in marks.PUSH)
            lines.append((f"push {newtons(push)}", (red, green, blue), font(round(unit), bold=True)))
        torn = [name for time, name in self._torn if time <= trajectory.time[row]]
        if torn:
            lines.append((f"{', '.join(torn)} torn off", ALARM, font(round(unit), bold=True)))
        if row == whole(trajectory) - 1 < trajectory.time.size - 1:
            lines.append(("diverged", ALARM, font(round(unit), bold=True)))
        step = 1.45 * unit
        top = self._size[1] - 1.1 * unit - step * len(lines) - 0.4 * unit
        self._box(draw, 0.7 * unit, top, 16.5 * unit, step * len(lines) + 0.6 * unit)
        for number, (words, fill, letters) in enumerate(lines):
            draw.text((1.3 * unit, top + 0.3 * unit + number * step), words, fill, letters)

    def _explain(self, draw: ImageDraw.ImageDraw, pixels_per_meter: float) -> None:
        """Draw the legend: what the arrows' colours and lengths mean."""
        unit, text = self._unit, font(round(0.85 * self._unit))
        limit = self._trajectory.scenario.contact.holding_limit
        pushes = bool(self._trajectory.scenario.disturbance.pushes)
        rows = 2 + (2.1 if limit else 1) + pushes
        width, height = 15.5 * unit, (1.5 * rows + 0.8) * unit
        left, top = self._size[0] - width - 0.7 * unit, self._size[1] - height - 0.7 * unit
        self._box(draw, left, top, width, height)
        x, y, swatch = left + 0.7 * unit, top + 0.55 * unit, 2.2 * unit

        def entry(rgb: Iterable[float], words: str) -> None:
            nonlocal y
            fill = tuple(int(255 * channel) for channel in rgb)
            middle = y + 0.6 * unit
            draw.line((x, middle, x + 0.65 * swatch, middle), fill, max(round(0.32 * unit), 2))
            tip = [(x + swatch, middle), (x + 0.6 * swatch, middle - 0.45 * unit)]
            draw.polygon([*tip, (x + 0.6 * swatch, middle + 0.45 * unit)], fill)
            draw.text((x + swatch + 0.6 * unit, y), words, WHITE, text)
            y += 1.5 * unit

        entry(marks.PRESSED, "foot force, pressed")
        entry(marks.pulled(0.5), f"pulled, share of {limit:g} N" if limit else "foot force, pulled")
        if limit:
            bar = round(width - 1.4 * unit)
            for pixel in range(bar):
                fill = tuple(int(255 * channel) for channel in marks.pulled(pixel / bar))
                draw.line((x + pixel, y, x + pixel, y + 0.55 * unit), fill)
            for share, anchor in ((0.0, "lt"), (0.5, "mt"), (1.0, "rt")):
                draw.text((x + share * bar, y + 0.7 * unit), f"{100 * share:.0f} %", DIM, text, anchor=anchor)
            y += 1.65 * unit
        if pushes:
            entry(marks.PUSH, "push on the base")
        newtons = _nice(0.55 * width / (self._scale * pixels_per_meter))
        length, middle = newtons * self._scale * pixels_per_meter, y + 0.7 * unit
        for line in ((x, middle, x + length, middle), *((e, middle - 4, e, middle + 4) for e in (x, x + length))):
            draw.line(line, WHITE, max(round(0.12 * unit), 1))
        draw.text((x + length + 0.6 * unit, y + 0.1 * unit), f"{newtons:g} N", WHITE, text)

    def _down(self, draw: ImageDraw.ImageDraw, view: View) -> None:
        """Draw which way is down: the picture's plane cuts gravity's direction; nothing where there is none."""
        gravity = np.asarray(self._trajectory.scenario.gravity)
        if np.linalg.norm(gravity) < MICROGRAVITY:
            return
        right, up, _ = view.axes()
        way = np.array([gravity @ right, -(gravity @ up)])
        unit, way = self._unit, way / max(np.linalg.norm(way), 1e-9)
        center = np.array([self._size[0] - 2.2 * unit, 2.9 * unit])
        self._box(draw, center[0] - 1.5 * unit, center[1] - 2.2 * unit, 3.0 * unit, 4.4 * unit)
        start, end, side = center - 1.6 * unit * way, center + 1.6 * unit * way, np.array([-way[1], way[0]])
        draw.line((*start, *(end - 0.6 * unit * way)), WHITE, max(round(0.2 * unit), 2))
        tip = [end, end - 0.9 * unit * way + 0.45 * unit * side, end - 0.9 * unit * way - 0.45 * unit * side]
        draw.polygon([tuple(corner) for corner in tip], WHITE)
        draw.text(tuple(center + 0.75 * unit * side), "g", WHITE, font(round(unit), bold=True), anchor="mm")


def newtons(value: float) -> str:
    """Return the size of a force in words."""
    if value > BEYOND:  # the walk has long failed: no number tells more
        return f"over {BEYOND / 1e3:g} kN"
    return f"{value:.1f} N" if value < 1000 else f"{value / 1e3:.1f} kN"


def _nice(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above the value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (5, 2, 1) if step * power <= value * (1 + 1e-9))
