"""Colours that the colour-blind can tell apart, and what they stand for in every picture."""

# Okabe & Ito, "Color Universal Design", 2008
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILLION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
LIMB_COLORS = (BLUE, ORANGE, GREEN, PURPLE, VERMILLION, SKY, "#8C6D31", "#4D4D4D")
AXIS_COLORS = (VERMILLION, SKY, BLACK)
# colour and width: the baseline is a broad band, so that what runs on top of it does not hide it
SERIES = (("0.65", 1.8), (VERMILLION, 0.8), (BLUE, 0.8), (GREEN, 0.8), (ORANGE, 0.8), (PURPLE, 0.8))
RED = "#D00000"  # what must not be passed: a torn gripper, on maps the baseline and the limit of stability
CARGO, PUSH = "#F6F0E1", "#DCE9F4"
GREY = "#BDBDBD"
SAME = "#EDEDED"  # a map on which all walks are equal
HELD = "#DDEFD9"  # on a map of detachments, the walks without any
