"""Draw films of robots that climb 2 m of random rock and along handrails.

python docs/images/climbs.py docs/images/climbs.webp          HubRobo on a wall and a ceiling, under lunar gravity
python docs/images/climbs.py docs/images/climbs_others.webp   six limbs on a ceiling, HubRobo on rails in microgravity
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "studies"))

from climb import BETWEEN, LUNAR, MICRO, WAY, scenario_of

import mjx_climb as mc
from mjx_climb.viz.rendering.film import pictures

SIZE, FRAMES_A_SECOND, TIMES_FASTER, QUALITY, TRACE = (400, 320), 8, 10, 10, 0.2
RAILS = {"rails": 2, "pitch": 0.05, "corner": [-0.4, -BETWEEN["hubrobo"] / 2], "size": [3.0, BETWEEN["hubrobo"]]}
# of each film: robot, rule, and what else is changed, by the words on a clip
CLIPS = {
    "climbs": {
        "wall": ("hubrobo", "best_margin", {"gravity": [-LUNAR, 0.0, 0.0]}),
        "ceiling": ("hubrobo", "best_margin", {"gravity": [0.0, 0.0, LUNAR]}),
    },
    "climbs_others": {
        "six limbs, ceiling": ("hexapod", "least_use", {"gravity": [0.0, 0.0, LUNAR]}),
        "rails, microgravity": ("hubrobo", "nearest", {"gravity": [0.0, 0.0, -MICRO], "ground.holds.rock": None,
                                                       "ground.holds.handrails": RAILS}),
    },
}  # fmt: skip


def main(path: str) -> None:
    """Climb twice, and write the film."""
    films = []
    for name, (robot, rule, changes) in CLIPS[Path(path).stem].items():
        scenario = scenario_of(robot, "base_admittance", rule, WAY).with_overrides({"duration": 100.0, **changes})
        walk = mc.rollout(scenario, dtype=np.float32)
        times = np.arange(0, scenario.duration, TIMES_FASTER / FRAMES_A_SECOND)
        label = f"{name}, {TIMES_FASTER} times as fast"
        films.append(list(pictures([walk], times, labels=[label], size=SIZE, trace=TRACE)))
        way = walk.base_position[-1] - walk.base_position[0]
        print(f"{name}: {way[0]:.2f} m ahead, {int(walk.torn_off.sum())} grips torn off")
    first, *rest = (Image.fromarray(np.concatenate(both, axis=1)) for both in zip(*films, strict=True))
    how = {"duration": 1000 // FRAMES_A_SECOND, "loop": 0, "quality": QUALITY, "method": 6}
    first.save(path, save_all=True, append_images=rest, **how)


if __name__ == "__main__":
    main(*sys.argv[1:])
