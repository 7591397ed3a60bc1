"""The largest foot force over time, drawn under a film: what arrows at one instant cannot show."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

from mjx_climb.plots.time_panels import thin
from mjx_climb.plots.walk_events import disturbances, failure_time, largest_foot_force
from mjx_climb.rendering.lettering import font
from mjx_climb.rendering.replay import row_at, whole
from mjx_climb.rollouts.trajectory import Trajectory

GROUND, SHADE, OTHERS, OWN, NOW = (22, 25, 30), (44, 50, 60), (118, 124, 132), (120, 190, 255), (255, 255, 255)
FINER = 2  # times the pixels while lines are drawn


class ForceTrace:
    """The forces of one walk, those of the walks beside it behind them, with a line that moves through time."""

    def __init__(self, trajectories: Sequence[Trajectory], number: int, size: tuple[int, int]):
        self._walk = trajectories[number]
        self._forces = largest_foot_force(self._walk)
        self._end = max(float(walk.time[-1]) for walk in trajectories)
        self._top = 1.08 * max(max(map(_highest, trajectories)), 1e-9)
        self._unit = max(size[1] / 6, 7.0)  # pixels, the height of a line of text
        self._left, self._size = 3.1 * self._unit, size
        self._picture = self._drawn(trajectories, number)

    def at(self, time: float) -> np.ndarray:
        """Return the strip (H, W, 3) at a time, s."""
        picture = self._picture.copy()
        draw = ImageDraw.Draw(picture)
        row = row_at(self._walk, time)
        x, y = self._place(float(self._walk.time[row]), float(self._forces[row]))
        draw.line((x, 0, x, self._size[1]), NOW, max(round(self._unit / 14), 1))
        reach = 0.22 * self._unit
        draw.ellipse((x - reach, y - reach, x + reach, y + reach), OWN, NOW)
        return np.asarray(picture)

    def _place(self, time: float, force: float) -> tuple[float, float]:
        """Return the pixel of a force, N, at a time, s."""
        width, height = self._size
        above = min(force / self._top, 1.0) if np.isfinite(force) else 1.0
        x = self._left + (width - 1.3 * self._left) * time / max(self._end, 1e-9)
        return x, height - 0.5 * self._unit - (height - 1.9 * self._unit) * above

    def _drawn(self, trajectories: Sequence[Trajectory], number: int) -> Image.Image:
        width, height = self._size
        image = Image.new("RGB", (FINER * width, FINER * height), GROUND)
        draw = ImageDraw.Draw(image)
        for start, stop, *_ in disturbances(self._walk):
            left, right = (FINER * self._place(time, 0.0)[0] for time in (start, min(stop, self._end)))
            draw.rectangle((left, FINER * 1.4 * self._unit, right, FINER * (height - 0.5 * self._unit)), SHADE)
        others = [walk for i, walk in enumerate(trajectories) if i != number]
        for walk, color in [*((walk, OTHERS) for walk in others), (self._walk, OWN)]:
            rows = whole(walk)
            time, forces = thin(walk.time[:rows], largest_foot_force(walk)[:rows])
            line = [FINER * pixel for point in zip(time, forces, strict=True) for pixel in self._place(*point)]
            draw.line(line, color, max(round(FINER * self._unit / 10), 1), joint="curve")
        image = image.resize(self._size, Image.Resampling.LANCZOS)
        draw, text = ImageDraw.Draw(image), font(round(0.85 * self._unit))
        words = "largest foot force" + (", the other walk's in grey" if others else "")
        draw.text((self._left, 0.2 * self._unit), words, (205, 208, 212), text)
        for force in (0.0, self._top / 1.08):
            place = (self._left - 0.35 * self._unit, self._place(0.0, force)[1])
            draw.text(place, f"{force:.2g} N" if force else "0", (205, 208, 212), text, anchor="rm")
        return image


def _highest(walk: Trajectory) -> float:
    """Return the largest force, N; of a walk that failed at most three times what was before."""
    forces = largest_foot_force(walk)[: whole(walk)]
    before = forces[walk.time[: whole(walk)] <= failure_time(walk)]
    return float(min(forces.max(), 3 * before.max() if before.size else np.inf))
