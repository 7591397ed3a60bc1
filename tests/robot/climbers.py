"""Climbers of any number of limbs and joints as MJCF: a yaw, pitches, and rolls between them, around a round base."""

import numpy as np

ROLLS = (3, 6)


def mjcf(limbs, joints, *, slides=(), attributes="", on_base="", reach=0.3):
    """Return the MJCF: joints L0_0, L0_1 ..., feet foot0, foot1 ...; `attributes` stand in every joint."""
    length = reach / (joints - 1)
    parts = []
    for limb in range(limbs):
        around = 2 * np.pi * (limb + 0.5) / limbs
        x, y = 0.08 * np.cos(around), 0.08 * np.sin(around)
        for joint in range(joints):
            kind, axis, limits = "hinge", "0 -1 0", "-150 10" if joint == 2 else "-90 90"
            if joint in slides:
                kind, axis, limits = "slide", "1 0 0", "-0.05 0.15"
            elif joint == 0:
                axis, limits = "0 0 1", "-60 60"
            elif joint == 1:
                limits = "-20 100"
            elif joint in ROLLS:
                axis = "1 0 0"
            place = f"{x} {y} 0" if joint == 0 else f"{0.03 if joint == 1 else length} 0 0"
            turn = f'euler="0 0 {np.degrees(around)}"' if joint == 0 else ""
            parts.append(
                f'<body name="L{limb}_{joint}" pos="{place}" {turn}>'
                f'<joint name="L{limb}_{joint}" type="{kind}" axis="{axis}" range="{limits}" {attributes}/>'
                f'<inertial pos="{length / 2} 0.002 0" mass="0.15" diaginertia="1e-4 1.2e-4 1e-4"/>'
            )
        parts.append(f'<site name="foot{limb}" pos="{length} 0 0"/>' + "</body>" * joints)
    return (
        '<mujoco><compiler autolimits="true"/><worldbody><body name="trunk"><freejoint/>'
        f'<inertial pos="0.003 0 0.01" mass="1.2" diaginertia="0.003 0.003 0.004"/>{on_base}{"".join(parts)}'
        "</body></worldbody></mujoco>"
    )


def config(path, limbs, joints, /, *, foothold=0.24, height=0.12, **more):
    """Return the robot and gait sections of a scenario: limb0, limb1 ... swing one after the other."""
    named = {}
    for limb in range(limbs):
        around = 2 * np.pi * (limb + 0.5) / limbs
        place = [foothold * np.cos(around), foothold * np.sin(around)]
        own = [f"L{limb}_{joint}" for joint in range(joints)]
        named[f"limb{limb}"] = {"joints": own, "foot": f"foot{limb}", "foothold": place}
    robot = {"file": str(path), "height": height, "limbs": named, **more}
    return {"robot": robot, "gait": {"sequence": list(named), "duty": max(1 - 1 / limbs, 0.75)}}
