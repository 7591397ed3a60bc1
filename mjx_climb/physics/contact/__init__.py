"""Contacts of feet and ground: their forces, and the loss of a grip (paper Eq. 5)."""
