"""The physics of one robot, as in the paper: Eq. 1 and what it needs, the contacts of Eq. 5, stability margins."""
