"""Walks made visible: frames, snapshots, videos and the interactive viewer.

from mjx_climb.viz import rendering

rendering.save_video("walk.mp4", trajectory, baseline)
strip = rendering.snapshots(trajectory, count=4)
"""

from mjx_climb.viz.rendering.backend import RenderingError
from mjx_climb.viz.rendering.film import encode, frames, pictures, save_image, save_video, snapshots, stance, view

__all__ = ["RenderingError", "encode", "frames", "pictures", "save_image", "save_video", "snapshots", "stance", "view"]
