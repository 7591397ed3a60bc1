"""The configs that come with the program: the paper's cases, robots of other limbs, ensembles, profiles of hardware."""

import os
from pathlib import Path

_ENSEMBLE = "ensemble"  # prefix of the names of ensembles
_HARDWARE = "hardware"  # the folder of profiles
_PACKAGES = Path(__file__).parents[2]
_FOLDERS = (_PACKAGES / "mjx_climb" / "configs", _PACKAGES / "configs")  # installed, or in a checkout


def names() -> list[str]:
    """Return the names of the shipped scenarios."""
    return [name for name in _stems() if not name.startswith(_ENSEMBLE)]


def ensembles() -> list[str]:
    """Return the names of the shipped ensembles."""
    return [name for name in _stems() if name.startswith(_ENSEMBLE)]


def profiles() -> list[str]:
    """Return the names of the shipped profiles of hardware."""
    return _stems(_HARDWARE)


def _stems(below: str = "") -> list[str]:
    return sorted({file.stem for folder in _FOLDERS for file in (folder / below).glob("*.yaml")})


def found(path: Path) -> Path:
    """Return the path of a file, or that of the shipped config where it is a bare name and no file.

    Raises:
        ConfigError: it is neither.
    """
    bare = len(path.parts) == 1 and path.name.isidentifier()
    return config_path(f"{path.name}.yaml") if bare and not os.path.exists(path) else path


def found_profile(path: Path) -> Path:
    """Return the path of a profile, as `found` does that of a config."""
    there = path.suffix or len(path.parts) > 1 or os.path.isfile(path)
    return path if there else _shipped(f"{path.name}.yaml", "a profile of hardware", _HARDWARE)


def config_path(name: str) -> Path:
    """Return where a shipped config lies, by its file's name; the error is that of `found`."""
    return _shipped(name, "a config that comes with the program")


def _shipped(name: str, what: str, below: str = "") -> Path:
    for folder in _FOLDERS:
        if os.path.isfile(path := folder / below / name):
            return path
    from mjx_climb.scenario.messages import ConfigError  # imports pydantic, which completion does not wait for

    raise ConfigError(Path(name).stem, "", f"a file, or {what} ({', '.join(_stems(below))})", "neither")
