"""The configs that come with the program: the paper's cases."""

from pathlib import Path

import mjx_climb
from mjx_climb.config import ConfigError


def config_path(name: str) -> Path:
    """Return where a shipped config lies: in the installed package, or beside it in a checkout.

    Raises:
        ConfigError: it is in neither place.
    """
    package = Path(mjx_climb.__file__).parent
    places = [package / "configs" / name, package.parent / "configs" / name]
    for place in places:
        if place.is_file():
            return place
    raise ConfigError(f"{name}: expected a config that comes with the program, got none in {places[0].parent}")
