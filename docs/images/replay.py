"""Cut docs/images/replay.webp, two joints of two limbs and the axis of time, out of what `mjx-climb replay` draws.

mjx-climb run case_1_2 --set duration=2 --out walk
mjx-climb replay case_1_2 --set duration=2 --hardware dynamixel_x --set hardware.command_delay=0 \
    --log walk/trajectory.nc --out replay
python docs/images/replay.py replay/replay.png docs/images/replay.webp
"""

import sys

from PIL import Image

WIDTH, QUALITY = 840, 80
RIGHT, LOW, AXIS = 1058, 1119, (2001, 2112)  # px of the picture: of the second limb, the second joint and the axis


def main(whole: str, path: str) -> None:
    """Cut both parts out and put one below the other."""
    drawn = Image.open(whole).convert("RGB")
    joints, axis = (drawn.crop((0, low, RIGHT, high)) for low, high in ((0, LOW), AXIS))
    both = Image.new("RGB", (RIGHT, joints.height + axis.height))
    both.paste(joints, (0, 0))
    both.paste(axis, (0, joints.height))
    both = both.resize((WIDTH, both.height * WIDTH // RIGHT))
    both.save(path, quality=QUALITY, method=6)


if __name__ == "__main__":
    main(*sys.argv[1:])
