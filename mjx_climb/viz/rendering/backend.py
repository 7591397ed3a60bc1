"""An OpenGL context without a window: EGL, OSMesa or the system's own, whichever works here."""

import functools
import os
import platform
import subprocess
import sys
import warnings

PACKAGES = {"egl": "libegl1 and libgl1", "osmesa": "libosmesa6"}  # Debian, Ubuntu
SYSTEMS_OWN = {"Linux": ("glx",), "Darwin": ("cgl",), "Windows": ("wgl",)}
ANY = ("", "on", "enable", "enabled", "true", "1")
OFF = ("disable", "disabled", "off", "false", "0")

# GLFW in C ends the process where there is no display, and PyOpenGL serves one platform per process: so each is tried
# in a process of its own
TRIAL = """
import sys, importlib, mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), 100)
"""
TRIAL_SECONDS = 60


class RenderingError(ValueError):
    """Rendering is not possible here; in one line: the missing part and the package to install."""


def has_display() -> bool:
    """Return whether a window can be opened."""
    return platform.system() != "Linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def require_display() -> None:
    """Make sure that a window can be opened.

    Raises:
        RenderingError: it cannot.
    """
    wanted, got = "a display", "neither DISPLAY nor WAYLAND_DISPLAY"
    if has_display():
        import glfw

        with warnings.catch_warnings(action="ignore"):  # GLFW's own words
            if glfw.init():
                return
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        wanted, got = "a display that opens windows", f"{display}, which does not"
    raise RenderingError(f"viewer: expected {wanted}, got {got}; a video needs none (--video)")


def works(name: str) -> bool:
    """Return whether MuJoCo can render through this context on this machine."""
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    trial = [sys.executable, "-c", TRIAL, name]
    try:
        return subprocess.run(trial, env=environment, capture_output=True, timeout=TRIAL_SECONDS).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


@functools.cache
def find() -> str:
    """Return the name of the first context that works: of the user's MUJOCO_GL, or of all that may work.

    Raises:
        RenderingError: none does, or MUJOCO_GL is none of them.
    """
    wanted, system = os.environ.get("MUJOCO_GL", "").lower().strip(), platform.system()
    if wanted in OFF:
        raise RenderingError(f"rendering: expected OpenGL, got MUJOCO_GL={os.environ['MUJOCO_GL']}, which turns it off")
    if wanted in ("egl", "osmesa", "glfw"):
        tried = [wanted]
    elif wanted not in (*ANY, *SYSTEMS_OWN.get(system, ())):
        raise RenderingError(f"MUJOCO_GL: expected egl, osmesa, glfw or off, got {wanted!r}")
    elif system == "Linux":
        tried = ["egl", "osmesa", *["glfw"] * has_display()]
    else:
        tried = ["cgl", "glfw"] if system == "Darwin" else ["glfw"]
    for name in tried:
        if works(name):
            return name
    packages = [PACKAGES[name] for name in tried if name in PACKAGES]
    raise RenderingError(
        f"rendering: expected OpenGL, got none that works (tried {', '.join(tried)}); "
        + (f"on Debian and Ubuntu install {', or '.join(packages)}" if packages else "MUJOCO_GL=egl needs no display")
    )
