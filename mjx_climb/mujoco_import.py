"""MuJoCo imported wherever it is installed, also without the OpenGL that MUJOCO_GL names: only pictures need that.

MuJoCo loads that OpenGL as it is imported, and ends in a traceback where it cannot.
"""

import contextlib
import ctypes
import ctypes.util
import importlib
import os
import sys
from types import ModuleType
from typing import Any

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}
# values of MUJOCO_GL that load no library of OpenGL
_OTHERS = ("", "glfw", "glx", *"enable enabled on true 1 disable disabled off false 0".split())


class InstallationError(ImportError):
    """MuJoCo is not there, or cannot be imported."""


def import_mujoco() -> ModuleType:
    """Import MuJoCo; without OpenGL where MUJOCO_GL asks for one that is not there.

    Raises:
        InstallationError: it is not there, or some of its files are not.
    """
    value = os.environ.get("MUJOCO_GL", "")
    usable = (wanted := value.lower().strip()) in _OTHERS
    if wanted in _LIBRARIES:
        with contextlib.suppress(OSError):
            usable = bool(ctypes.CDLL(ctypes.util.find_library(_LIBRARIES[wanted]) or "nowhere"))
    if not usable and "mujoco" not in sys.modules:
        os.environ["MUJOCO_GL"] = "disable"
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        reason = str(error).partition(". ")[0]
        raise InstallationError(f"mujoco: {reason}; mjx-climb doctor says what to do") from error
    finally:
        if value:
            os.environ["MUJOCO_GL"] = value


mujoco: Any = import_mujoco()
