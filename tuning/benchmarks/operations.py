"""How many operations a step of the closed loop needs, counted by hand from the equations.

Counted are additions, subtractions, products, quotients, minima, maxima and absolute values of one robot under base
admittance with its virtual model, metrics included; every shared quantity once. Comparisons and selections are not, nor
are operations that all robots share (the gait's timing and curves) or that are done once a walk. Sines, cosines, arc
tangents and square roots are counted apart, as XLA's cost analysis does. Each term stands for one line of the code it
names.
"""

DOT, CROSS, ROTATE, COMPOSE = 5, 9, 15, 45  # of vectors and 3 x 3 matrices
SYMMETRIC_TIMES = 15  # symmetric matrix by vector
ROTATED_INERTIA = COMPOSE + 6 * DOT
QUATERNION_MATRIX, QUATERNION_PRODUCT = 30, 28
FACTORIZE, SOLVE = 14, 15  # 3 x 3, one right-hand side

LIMBS, LINKS = 4, 3

# of each limb; a sum over limbs counts as one addition per limb and component
LIMB = {
    "link frames": LINKS * (ROTATE + 3 + COMPOSE + 18) + ROTATE + 3,  # 18: the joint turns two columns
    "feet": LINKS * (3 + CROSS) + CROSS + 3 + LINKS * 6 + 3,  # levers and Jacobian, velocity, position
    "grip": 3 + 12 + DOT,  # stretch, spring and damper, magnitude
    "wrench on the base": CROSS + 6,
    # into the base frame and the limb's own, yaw and plane, law of cosines, femur, tibia, wrapping
    "inverse kinematics": (3 + ROTATE) + (3 + ROTATE) + (4 + 1 + 2) + (6 + 3) + (3 + 1 + 2) + 3 + 6,
    "joint loop": LINKS * 4,
    "Newton-Euler outward": LINKS
    * (
        (3 + CROSS + 2 * CROSS + 6)  # acceleration of the joint
        + (3 + CROSS + 3 + 3)  # joint rate, angular acceleration and velocity
        + (ROTATE + CROSS + 2 * CROSS + 6)  # acceleration of the centre of mass
        + 3  # force
        + (ROTATED_INERTIA + 2 * SYMMETRIC_TIMES + CROSS + 3)  # moment
        + (3 + CROSS + 3)  # moment about the base
        + (3 + 12 + 6)  # inertia about the base
    ),
    "composites inward": 2 * (1 + 3 + 6 + 6)
    + LINKS * CROSS  # joint axes as motions about the base
    + LINKS * (2 * DOT + 1)  # bias
    + LINKS * (3 + CROSS + 3 + SYMMETRIC_TIMES + CROSS + 3)  # couplings: momentum of each joint's composite
    + 6 * (2 * DOT + 1),  # 3 x 3 block
    "elimination of the joints": (3 + LINKS * DOT + 3)  # joint forces
    + FACTORIZE
    + (6 + 1) * SOLVE
    + 2 * ROTATE  # base wrench
    + (6 + 6 + 9) * DOT  # Schur complement
    + 42  # sums over limbs: three wrenches less one, composite, Schur complement
    + (2 * ROTATE + 6),  # joint accelerations
    "integration": LINKS * 4,
    "centre of mass": LINKS * 3,
    "support polygon": 2 * (3 + 3 + CROSS) + 3 + CROSS,
    "net wrench": CROSS + 6,
    "tumble stability": DOT + (2 * DOT + 1) + 2 * (DOT + 2) + 4,
    "gravito-inertial margin": 6 + CROSS + 3 + (DOT + 1) + DOT + 3,
    "metrics": 1 + 9 + 12 + 6 + DOT,  # force, power, joint limits, torque, rates
}

BASE = {
    "rotation matrices": 2 * QUATERNION_MATRIX,  # of the base and of its target
    "virtual model": 2 * ROTATE + 6 + 6 * 2 * 6,
    "shift of the base": 15 + QUATERNION_PRODUCT + ROTATE + 3,
    "forces": ROTATED_INERTIA + 6 + 10 + (CROSS + SYMMETRIC_TIMES + 6),
    "6 x 6 block": 7 + 12 + 9,
    "6 x 6 solution": 2 * FACTORIZE + 5 * SOLVE + 6 * (DOT + 1) + 2 * (ROTATE + 3),
    "integration": 12 + 6 + (3 + 15 + QUATERNION_PRODUCT + 11),
    "net wrench and centre of mass": (CROSS + 9) + 6,
    "margins and metrics": 6 + (3 + DOT) + 3 + 9,
}

BY_HAND = LIMBS * sum(LIMB.values()) + sum(BASE.values())

# of each limb: sin and cos of the joints, inverse kinematics, norms of force and rates, margins; then of the base
TRANSCENDENTAL_BY_HAND = LIMBS * (2 * LINKS + (2 + 5) + 2 + (1 + 2) + 1) + (3 + 3 + 1) + 1
