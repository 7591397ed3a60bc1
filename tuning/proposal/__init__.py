"""A scenario proposed from a robot's file: limbs, feet, a stance that is searched, gait and gains in proportion."""
