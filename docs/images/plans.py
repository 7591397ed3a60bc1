"""Draw docs/images/plans.webp: case 2 on Dynamixel X servos, under pd, load transfer and the plan that knows all.

    python docs/images/plans.py docs/images/plans.webp [gradients]

The plan is searched first, for the walk of the config: minutes on two cores.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import tuning
from mjx_climb.viz.rendering.film import pictures

sys.path.append(str(Path(__file__).parents[1] / "studies"))

import ceiling as study

SIZE, FRAMES_A_SECOND, QUALITY, TRACE, SECONDS = (480, 300), 10, 30, 0.3, (0.5, 7.5)
SHOWN = {"retuned_pd": "pd, searched", "load_transfer": "load transfer", "clairvoyant": "all known"}


def main(path: str, gradients: str = "60") -> None:
    """Search the plan, walk three times, and write the film."""
    scenario = study.scenario_of("dynamixel_x", "2", 8.0)
    laws = study.laws_of(scenario, "dynamixel_x", "2", None, None)
    how = {"knots": (0.2, 0.1), "delays": (), "random": 0, "iterations": int(gradients), "weights": study.WEIGHTS}
    found = tuning.ceiling(scenario, laws, progress=lambda *done: print(*done, flush=True), **how)
    walks = [found.first[name].trajectory() for name in SHOWN]
    times = np.arange(*SECONDS, 1 / FRAMES_A_SECOND)
    shown = pictures(walks, times, labels=[*SHOWN.values()], size=SIZE, trace=TRACE)
    first, *rest = (Image.fromarray(np.concatenate(np.split(picture, 3, axis=1))) for picture in shown)
    how = {"duration": 1000 // FRAMES_A_SECOND, "loop": 0, "quality": QUALITY, "method": 6}
    first.save(path, save_all=True, append_images=rest, **how)


if __name__ == "__main__":
    main(*sys.argv[1:])
