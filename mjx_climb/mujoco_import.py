"""MuJoCo imported wherever it is installed, also without the OpenGL that MUJOCO_GL names: only pictures need that.

MuJoCo loads that OpenGL as it is imported, and ends in a traceback where it cannot.
"""

import ctypes
import ctypes.util
import importlib
import os
import sys
from types import ModuleType
from typing import Any

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
KNOWN = ("", "glfw", "glx", *"enable enabled on true 1 disable disabled off false 0".split())
_VARIABLE = "MUJOCO_GL"


def _unusable(wanted: str) -> bool:
    """Return whether MuJoCo's import would fail for this value of MUJOCO_GL."""
    if wanted not in LIBRARIES:
        return wanted not in KNOWN
    try:
        ctypes.CDLL(ctypes.util.find_library(LIBRARIES[wanted]) or "nowhere")
    except OSError:
        return True
    return False


def import_mujoco() -> ModuleType:
    """Import MuJoCo; without OpenGL where MUJOCO_GL asks for one that is not there."""
    value = os.environ.get(_VARIABLE)
    if value is None or "mujoco" in sys.modules or not _unusable(value.lower().strip()):
        return importlib.import_module("mujoco")
    os.environ[_VARIABLE] = "disable"
    try:
        return importlib.import_module("mujoco")
    finally:
        os.environ[_VARIABLE] = value


mujoco: Any = import_mujoco()
