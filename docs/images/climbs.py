"""Draw docs/images/climbs.webp: HubRobo climbs 2 m of random rock, on a wall and on a ceiling, under lunar gravity.

python docs/images/climbs.py docs/images/climbs.webp
"""

import sys

import numpy as np
from PIL import Image

import mjx_climb as mc
from mjx_climb.scenario.shipped import config_path
from mjx_climb.viz.rendering.film import pictures

SIZE, FRAMES_A_SECOND, TIMES_FASTER, QUALITY, TRACE = (400, 320), 8, 10, 24, 0.2
LUNAR = 1.62  # m/s^2
GRAVITY = {"wall": [-LUNAR, 0.0, 0.0], "ceiling": [0.0, 0.0, LUNAR]}


def main(path: str) -> None:
    """Climb twice, and write the film."""
    films = []
    for name, gravity in GRAVITY.items():
        scenario = mc.load_scenario(config_path("climb_rock.yaml")).with_overrides({"gravity": gravity})
        walk = mc.rollout(scenario, dtype=np.float32)
        times = np.arange(0, scenario.duration, TIMES_FASTER / FRAMES_A_SECOND)
        label = f"{name}, {TIMES_FASTER} times as fast"
        films.append(list(pictures([walk], times, labels=[label], size=SIZE, trace=TRACE)))
        way = walk.base_position[-1] - walk.base_position[0]
        print(f"{name}: {way[0]:.2f} m ahead, {int(walk.torn_off.sum())} grips torn off")
    first, *rest = (Image.fromarray(np.concatenate(both, axis=1)) for both in zip(*films, strict=True))
    how = {"duration": 1000 // FRAMES_A_SECOND, "loop": 0, "quality": QUALITY, "method": 4}
    first.save(path, save_all=True, append_images=rest, **how)


if __name__ == "__main__":
    main(*sys.argv[1:])
