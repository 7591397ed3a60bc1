"""Pictures into files: PNG, and videos that browsers and slides play (H.264 in MP4)."""

import io
import os
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from mjx_climb.files.writing import whole, write_bytes_atomically
from mjx_climb.rendering import film
from mjx_climb.rollouts.trajectory import Trajectory

QUALITY = "20"  # x264's constant rate factor: smaller is better and larger


def save_video(
    path: str | os.PathLike[str],
    *trajectories: Trajectory,
    labels: Sequence[str] | None = None,
    fps: int = film.FPS,
    size: tuple[int, int] = film.SIZE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write walks as an MP4 video, side by side and in sync, and return its path.

    The file is either whole or not there.

    Arguments:
        path: ends in .mp4.
        trajectories: walks of one robot.
        labels: above each; its controller by default.
        fps: frames per second.
        size: width and height of one walk's picture, even numbers of pixels.
        progress: told how many frames are done, and of how many.

    Raises:
        RenderingError: no OpenGL on this machine.
        OutputError: the file cannot be written.
        ValueError: what cannot be shown.
    """
    film.check(trajectories, labels, size)
    times = film.frame_times(trajectories, fps)
    pictures = film.pictures(trajectories, times, labels=labels, size=size, trace=film.TRACE)
    return encode(path, pictures, fps, (size[0] * len(trajectories), size[1]), lambda done: progress(done, times.size))


def encode(
    path: str | os.PathLike[str],
    pictures: Iterable[np.ndarray],
    fps: int,
    size: tuple[int, int],
    progress: Callable[[int], None] = lambda done: None,
) -> Path:
    """Write pictures (H, W, 3) uint8 of one size (W, H) as an H.264 video and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    import av

    # the index in front lets a browser start before all is there
    first = {"movflags": "+faststart"}
    with whole(path) as part, av.open(str(part), "w", format="mp4", options=first) as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": QUALITY, "preset": "veryfast"})
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"  # what all players decode
        stream.codec_context.time_base = Fraction(1, fps)
        for done, picture in enumerate(pictures, 1):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            progress(done)
        container.mux(stream.encode(None))
    return Path(path)


def save_image(path: str | os.PathLike[str], picture: np.ndarray) -> Path:
    """Write a picture (H, W, 3) uint8 as PNG and return its path.

    Raises:
        OutputError: the file cannot be written.
    """
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return write_bytes_atomically(path, buffer.getvalue())
