"""What `mjx-climb run` shows beside numbers and plots: a video, a strip of snapshots, the viewer."""

import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tuning.command_line import options
from tuning.command_line.ending import InputError

if TYPE_CHECKING:
    import mjx_climb as mc
    from tuning.output.stages import Stage

Video = Annotated[bool, typer.Option("--video", help="Render the walk to walk.mp4 (H.264); works without a display.")]
Snapshots = Annotated[
    bool,
    typer.Option("--snapshots", help="Render a strip of four snapshots, snapshots.png; other instants with --at."),
]
At = Annotated[
    str | None,
    typer.Option(
        "--at", metavar="T,T,...", help="Instants of the snapshots, s; for example 2.5,4.6", show_default=False
    ),
]
Compare = Annotated[
    options.ControllerName | None,
    typer.Option(help="Walk under this controller too, and show both side by side, in sync, this one first."),
]
Size = Annotated[
    str | None,
    typer.Option(
        metavar="WIDTHxHEIGHT",
        help="Pixels of one walk's picture.",
        show_default="1280x720; two walks 960x720; a snapshot 800x600",
    ),
]
View = Annotated[
    bool,
    typer.Option(
        "--view",
        help="Replay the walk in MuJoCo's viewer, with --compare both in turn, until its window is closed.",
    ),
]


@dataclasses.dataclass(frozen=True)
class Pictures:
    """What is wanted, checked before anything is walked."""

    video: bool
    instants: tuple[float, ...]  # of snapshots, s; empty: no strip
    size: tuple[int, int] | None  # pixels

    def write(
        self, walks: "Sequence[mc.Trajectory]", folder: Path, stage: "Stage", labels: Sequence[str] | None = None
    ) -> list[str]:
        """Render walks side by side into a folder and return the names of the files."""
        from mjx_climb import rendering
        from mjx_climb.rendering import film

        files = []
        if self.video:
            size = self.size or (film.SIZE if len(walks) == 1 else film.PAIR_SIZE)
            with stage("video", compiles=False, unit="frames") as show:
                step = 1 if sys.stderr.isatty() else 50  # in a log, a line every two seconds of film

                def told(done: int, total: int) -> None:
                    if done % step == 0 or done == total:
                        show(done, total)

                show(0, 1)
                rendering.save_video(folder / "walk.mp4", *walks, size=size, labels=labels, progress=told)
            files.append("walk.mp4")
        if self.instants:
            with stage("snapshots", compiles=False):
                strip = rendering.snapshots(
                    *walks, times=self.instants, size=self.size or film.SNAPSHOT_SIZE, labels=labels
                )
                rendering.save_image(folder / "snapshots.png", strip)
            files.append("snapshots.png")
        return files


def pictures_from(
    video: bool, snapshots: bool, at: str | None, size: str | None, view: bool, scenario: "mc.Scenario"
) -> Pictures:
    """Return what the options ask for.

    Raises:
        InputError: an option that cannot be used.
        RenderingError: this machine cannot render what is asked for.
    """
    if at is not None and not snapshots:
        raise InputError("--at: expected --snapshots beside it")
    instants: tuple[float, ...] = ()
    pixels = None if size is None else _size(size)
    if video or snapshots or view:
        from mjx_climb.rendering import backend, film

        if video or snapshots:
            backend.find()
        if view:
            backend.require_display()
        if snapshots:
            even = [(k + 0.5) / film.SNAPSHOTS * scenario.duration for k in range(film.SNAPSHOTS)]
            instants = tuple(even) if at is None else _instants(at, scenario.duration)
    return Pictures(video, instants, pixels)


def compared(scenario: "mc.Scenario", controller: str | None) -> "mc.Scenario | None":
    """Return the scenario under the controller to compare with, None where none is wanted.

    Raises:
        InputError: it is the scenario's own.
    """
    if controller is None:
        return None
    if controller == scenario.control.controller:
        raise InputError(f"--compare: expected a controller other than the walk's own, got {controller}")
    return scenario.with_overrides({"control.controller": controller, "control.reading": "virtual_model"})


def _size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) == 2 and all(part.isascii() and part.isdecimal() and len(part) < 6 for part in parts):
        width, height = map(int, parts)
        if all(64 <= pixels <= 4096 and pixels % 2 == 0 for pixels in (width, height)):
            return width, height
    raise InputError(f"--size: expected WIDTHxHEIGHT, even numbers from 64 to 4096, got {text!r}")


def _instants(text: str, duration: float) -> tuple[float, ...]:
    try:
        instants = tuple(float(part) for part in text.split(","))
    except ValueError:
        instants = ()
    if not 0 < len(instants) <= 12 or not all(math.isfinite(t) and 0 <= t <= duration for t in instants):
        raise InputError(f"--at: expected up to 12 times from 0 to {duration:g} s, separated by commas, got {text!r}")
    return instants
