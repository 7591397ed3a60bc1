"""A parameter to identify: by which factor all links are heavier than the robot's file says."""

import dataclasses

from tuning.identification.model.variables import Variable


def heavier(factor, parameters, robot):
    """Return parameters and robot at a value of it; at its nominal one they are as they were."""
    links = {"link_mass": factor * robot.link_mass, "link_inertia": factor * robot.link_inertia}
    return parameters, dataclasses.replace(robot, **links)


# log: it moves by its logarithm, of which `mean` and `sd` are the prior
links = Variable("links", "1", nominal=1.0, mean=0.0, sd=0.3, lower=0.1, upper=10.0, log=True, change=heavier)
