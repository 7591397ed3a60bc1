"""What `mjx-climb run` shows beside numbers and plots: a video, a strip of snapshots, the viewer."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import BeforeValidator

from tuning.command_line.ending import InputError
from tuning.command_line.options import ControllerName
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    import mjx_climb as mc
    from tuning.background import Stage

MOST_SNAPSHOTS = 12


def _pixels(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) == 2 and all(part.isascii() and part.isdecimal() and len(part) < 6 for part in parts):
        width, height = map(int, parts)
        if all(64 <= pixels <= 4096 and pixels % 2 == 0 for pixels in (width, height)):
            return width, height
    raise ValueError(f"expected WIDTHxHEIGHT, even numbers from 64 to 4096, got {text!r}")


class Pictures(Options):
    """What is rendered, and which other walk is shown beside."""

    compare: ControllerName | None = setting(
        None, "walk under this controller too, and show both side by side, in sync, this one first"
    )
    video: bool = setting(False, "render the walk to walk.mp4 (H.264); works without a display")
    snapshots: bool = setting(False, "render a strip of four snapshots, snapshots.png; other instants with --at")
    at: Annotated[tuple[float, ...], BeforeValidator(lambda text: text.split(","))] = setting(
        (), "instants of the snapshots, s; for example 2.5,4.6", metavar="T,T,..."
    )
    size: Annotated[tuple[int, int] | None, BeforeValidator(_pixels)] = setting(
        None,
        "pixels of one walk's picture; null: 1280x720; two walks 960x720; a snapshot 800x600",
        metavar="WIDTHxHEIGHT",
    )
    view: bool = setting(
        False, "replay the walk in MuJoCo's viewer, with --compare both in turn, until its window is closed"
    )

    def check(self, scenario: "mc.Scenario") -> None:
        """Check, before anything is walked, that what is asked for can be shown.

        Raises:
            InputError: an option that cannot be used.
            RenderingError: this machine cannot render what is asked for.
        """
        if self.at and not self.snapshots:
            raise InputError("--at: expected --snapshots beside it")
        if len(self.at) > MOST_SNAPSHOTS or not all(0 <= t <= scenario.duration for t in self.at):
            raise InputError(
                f"--at: expected up to {MOST_SNAPSHOTS} times from 0 to {scenario.duration:g} s, separated by commas, "
                f"got {','.join(f'{t:g}' for t in self.at)!r}"
            )
        if self.compare == scenario.control.controller:
            raise InputError(f"--compare: expected a controller other than the walk's own, got {self.compare}")
        if self.video or self.snapshots or self.view:
            from mjx_climb.rendering import backend

            if self.video or self.snapshots:
                backend.find()
            if self.view:
                backend.require_display()

    def compared(self, scenario: "mc.Scenario") -> "mc.Scenario | None":
        """Return the scenario under the controller to compare with, None where none is wanted."""
        changes = {"control.controller": self.compare, "control.reading": "virtual_model"}
        return None if self.compare is None else scenario.with_overrides(changes)

    def write(self, walks: "Mapping[str, mc.Trajectory]", folder: Path, stage: "Stage") -> list[str]:
        """Render walks side by side, each under its name, into a folder and return the names of the files."""
        from mjx_climb import rendering
        from mjx_climb.rendering import film

        files, shown, labels = [], list(walks.values()), list(walks) if len(walks) > 1 else None
        if self.video:
            with stage("video", compiles=False, unit="frames") as show:
                step = 1 if sys.stderr.isatty() else 50  # in a log, a line every two seconds of film

                def told(done: int, total: int) -> None:
                    if done % step == 0 or done == total:
                        show(done, total)

                show(0, 1)
                size = self.size or (film.SIZE if len(walks) == 1 else film.PAIR_SIZE)
                rendering.save_video(folder / "walk.mp4", *shown, size=size, labels=labels, progress=told)
            files.append("walk.mp4")
        if self.snapshots:
            duration = shown[0].scenario.duration
            even = [(k + 0.5) / film.SNAPSHOTS * duration for k in range(film.SNAPSHOTS)]
            with stage("snapshots", compiles=False):
                strip = rendering.snapshots(
                    *shown, times=self.at or tuple(even), size=self.size or film.SNAPSHOT_SIZE, labels=labels
                )
                rendering.save_image(folder / "snapshots.png", strip)
            files.append("snapshots.png")
        return files
