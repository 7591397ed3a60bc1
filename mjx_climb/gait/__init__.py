"""The reference motion: schedule of the limbs, their swings, path of the base."""
