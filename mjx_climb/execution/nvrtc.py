"""CUDA C compiled to PTX by NVRTC, a library that every installation of JAX for NVIDIA's GPUs brings."""

import ctypes
import functools
import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Any

from mjx_climb.execution.elements import Unsupported

# Multiplications and additions in one, numbers below 1e-38 as zero, and divisions and roots to two units in the last
# place: what single precision is good for is lost in none of them.
OPTIONS = ("--fmad=true", "--ftz=true", "--prec-div=false", "--prec-sqrt=false", "--std=c++17")


@functools.lru_cache(maxsize=32)
def ptx(source: str, capability: str) -> str:
    """Return a kernel in PTX.

    Arguments:
        source: in CUDA C, without includes.
        capability: the GPU's compute capability, as "9.0".

    Raises:
        Unsupported: no NVRTC, or it does not compile this.
    """
    library = _library()
    program = ctypes.c_void_p()
    _call(library.nvrtcCreateProgram, ctypes.byref(program), source.encode(), b"walk.cu", 0, None, None)
    try:
        options = [f"--gpu-architecture=compute_{capability.replace('.', '')}", *OPTIONS]
        array = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
        if library.nvrtcCompileProgram(program, len(options), array):
            log = _text(library.nvrtcGetProgramLogSize, library.nvrtcGetProgramLog, program)
            wrong = next((line for line in log.splitlines() if "error" in line), log)
            raise Unsupported(f"what NVRTC does not compile: {wrong.strip()[:200]}")
        return _text(library.nvrtcGetPTXSize, library.nvrtcGetPTX, program)
    finally:
        library.nvrtcDestroyProgram(ctypes.byref(program))


def _text(size_of: Any, get: Any, program: ctypes.c_void_p) -> str:
    size = ctypes.c_size_t()
    _call(size_of, program, ctypes.byref(size))
    text = ctypes.create_string_buffer(size.value)
    _call(get, program, text)
    return text.value.decode()


def _call(function: Any, *arguments: object) -> None:
    if error := function(*arguments):
        raise Unsupported(f"what NVRTC does not do: error {error} of {function.__name__}")


@functools.cache
def _library() -> ctypes.CDLL:
    for place in _places():
        try:
            return ctypes.CDLL(place)
        except OSError:
            continue
    raise Unsupported("anything without NVRTC (libnvrtc.so; pip install 'jax[cuda13]' brings it)")


def _places() -> list[str]:
    """Return where the library may be: of the CUDA that JAX's plugin is made for, then of any."""
    found = []
    for major in sorted(("13", "12"), key=lambda major: not _plugin(major)):
        name = f"libnvrtc.so.{major}"
        spec = importlib.util.find_spec("nvidia")
        for folder in () if spec is None else spec.submodule_search_locations or ():
            for inside in (f"cu{major}/lib", "cuda_nvrtc/lib"):
                found.append(str(Path(folder) / inside / name))
        found.append(name)
    return found


def _plugin(major: str) -> bool:
    try:
        importlib.metadata.version(f"jax-cuda{major}-plugin")
    except importlib.metadata.PackageNotFoundError:
        return False
    return True
