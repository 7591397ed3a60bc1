"""Contacts of feet and ground: their forces, and the loss of a grip (paper Eq. 5)."""

from mjx_climb.physics.contact.contact import Contact
from mjx_climb.physics.contact.gripper import Gripper
from mjx_climb.physics.contact.polyhedron import PolyhedralGripper
from mjx_climb.physics.contact.uncertain import UncertainGripper

# by the names that --contact and `contact.kind` take
KINDS: dict[str, type[Contact]] = {"gripper": Gripper, "polyhedron": PolyhedralGripper, "uncertain": UncertainGripper}
