"""The physics of one robot, as in the paper: Eq. 1 and its terms, the contacts of Eq. 5, stability margins."""
