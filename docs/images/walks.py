"""Draw docs/images/walks.webp: case 1.2 on Dynamixel X servos, walked under pd and under load transfer.

python docs/images/walks.py docs/images/walks.webp
"""

import sys

import numpy as np
from PIL import Image

import mjx_climb as mc
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.shipped import config_path
from mjx_climb.viz.rendering.film import pictures
from tuning.gains import gains_file
from tuning.problem.evaluation import under_pd

SIZE, FRAMES_A_SECOND, QUALITY, TRACE = (480, 270), 10, 30, 0.25


def main(path: str) -> None:
    """Walk twice, and write the film."""
    scenario = with_hardware(mc.load_scenario("case_1_2"), load_hardware("dynamixel_x"))
    gains = config_path("gains/dynamixel_x_case_1_2_best.yaml")
    walked, law = gains_file.replaced(*(own := gains_file.walker(gains, scenario)), gains_file.load(gains, own[1]))
    walks = [mc.rollout(under_pd(scenario)), mc.rollout(walked, law=law)]
    times = np.arange(0, scenario.duration, 1 / FRAMES_A_SECOND)
    shown = pictures(walks, times, labels=["pd", "load transfer"], size=SIZE, trace=TRACE)
    # one above the other: side by side a phone's 400 px leave their words too small
    first, *rest = (Image.fromarray(np.concatenate(np.split(picture, 2, axis=1))) for picture in shown)
    how = {"duration": 1000 // FRAMES_A_SECOND, "loop": 0, "quality": QUALITY, "method": 6}
    first.save(path, save_all=True, append_images=rest, **how)


if __name__ == "__main__":
    main(*sys.argv[1:])
