"""The configs that come with the program: the paper's cases, robots of other limbs, and ensembles of walks."""

import os
from pathlib import Path

_ENSEMBLE = "ensemble"  # what the names of ensembles begin with
_PACKAGES = Path(__file__).parents[2]
_FOLDERS = (_PACKAGES / "mjx_climb" / "configs", _PACKAGES / "configs")  # installed, or in a checkout


def names() -> list[str]:
    """Return the names of the shipped scenarios."""
    return [name for name in _stems() if not name.startswith(_ENSEMBLE)]


def ensembles() -> list[str]:
    """Return the names of the shipped ensembles."""
    return [name for name in _stems() if name.startswith(_ENSEMBLE)]


def _stems() -> list[str]:
    return sorted({file.stem for folder in _FOLDERS for file in folder.glob("*.yaml")})


def profiles() -> list[str]:
    """Return the names of the shipped profiles of hardware."""
    return sorted({file.stem for folder in _FOLDERS for file in (folder / "hardware").glob("*.yaml")})


def found_profile(path: Path) -> Path:
    """Return the path of a profile, or that of the shipped one where it is a bare name and no file.

    Raises:
        ConfigError: it is neither.
    """
    if path.suffix or len(path.parts) > 1 or os.path.isfile(path):
        return path
    for folder in _FOLDERS:
        if os.path.isfile(shipped := folder / "hardware" / f"{path.name}.yaml"):
            return shipped
    from mjx_climb.scenario.messages import ConfigError

    raise ConfigError(f"{path.name}: expected a file, or a profile of hardware ({', '.join(profiles())}), got neither")


def config_path(name: str) -> Path:
    """Return where a shipped config lies, by its file's name.

    Raises:
        ConfigError: there is none of that name.
    """
    for folder in _FOLDERS:
        if os.path.isfile(path := folder / name):
            return path
    from mjx_climb.scenario.messages import ConfigError

    known = ", ".join(_stems())
    raise ConfigError(
        f"{Path(name).stem}: expected a file, or a config that comes with the program ({known}), got neither"
    )


def found(path: Path) -> Path:
    """Return the path of a file, or that of the shipped config where it is a bare name and no file.

    Raises:
        ConfigError: it is neither.
    """
    bare = len(path.parts) == 1 and not path.suffix and path.name.isidentifier()
    return config_path(f"{path.name}.yaml") if bare and not os.path.exists(path) else path
