"""Force sensors that fall silent: when they are believed, what laws then get, and how stiff the joints become."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import sensor_watch

STEP = 5e-3
WALK = {
    "duration": 0.6, "control.kp": 20.0, "control.safe_kp": 50.0, "contact.holding_limit": None,
    "hardware.force_sensor.dead": {"RH": 0.1},
}  # fmt: skip


@jax.jit
def _watched(readings, support):
    def step(watch, now):
        watch, force, known = sensor_watch.watched(watch, *now, STEP)
        return watch, (force, known, watch.lost, watch.kp_rise)

    return jax.lax.scan(step, sensor_watch.begin(readings[0]), (readings, support))[1]


def heard(readings, support=True, others=2.0):
    """Return forces, whether they are known, whether the first sensor is lost, and how far kp has risen, step by step.

    The first sensor reads newtons along z; others stand, and each reads so many in each axis together.
    """
    first, stands, of_others = np.broadcast_arrays(readings, support, others)
    force, standing = np.tile(of_others[:, None, None] / 3, (1, 4, 3)), np.ones((len(first), 4), bool)
    force[:, 0], standing[:, 0] = 0.0, stands
    force[:, 0, 2] = first
    force, known, lost, kp_rise = map(np.asarray, _watched(force, standing))
    assert (force[~known] == 0).all()
    return force, known, lost[:, 0], kp_rise


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf])
def test_a_sensor_is_dead_after_a_tenth_of_a_second_without_a_reading(nothing):
    """Until then its last reading holds, then no force is known; it is lost after as much again, until it reads."""
    force, known, lost, _ = heard([3.0] * 2 + [nothing] * 60 + [1.0])
    assert known[:20].all() and (force[:20, 0] == [0, 0, 3]).all() and not known[24:62].any()
    assert not lost[:40].any() and lost[44:62].all()
    assert known[62] and not lost[62] and force[62, 0, 2] == 1.0


def test_a_sensor_that_flickers_or_has_just_touched_down_is_no_dead_one():
    """Of nine in ten samples without a reading none is missed; a foot in the air is told to bear nothing."""
    _, known, lost, _ = heard(np.tile([2.0] + [0.0] * 9, 20))
    assert known.all() and not lost.any()
    force, known, lost, _ = heard([5.0] + [0.0] * 69, [True] * 2 + [False] * 50 + [True] * 18)
    assert known.all() and not lost.any() and not force[2:, 0].any()


def test_a_dead_sensor_stays_dead_over_a_swing_and_one_that_never_read_anything_is_dead():
    _, known, lost, _ = heard([5.0] + [0.0] * 119, [True] * 60 + [False] * 20 + [True] * 40)
    assert not known[60:].any() and lost[60:].all()
    _, known, lost, _ = heard([0.0] * 60)
    assert not known.any() and not lost[:18].any() and lost[22:].all()


def test_a_silent_sensor_is_doubted_in_stances_alone_and_whatever_the_others_bear_by_then():
    """Silent for 0.15 s, it counts for nothing in the air, is not believed of the foot that stands again, then lost."""
    _, known, lost, _ = heard([5.0] + [0.0] * 79, [True] * 31 + [False] * 20 + [True] * 29)
    assert not known[22:31].any() and known[31:51].all() and not known[51:].any()
    assert not lost[:58].any() and lost[64:].all()
    # the robot lies down: that the others bear nothing any more does not excuse it
    _, known, lost, _ = heard([0.0] * 80, others=np.where(np.arange(80) < 5, 2.0, 0.1))
    assert not known.any() and not lost[:18].any() and lost[22:].all()


def test_where_nothing_bears_anything_no_reading_says_nothing():
    """Without weight, of sensors that tell a tenth of a newton."""
    for first in (0.1, 0.0):
        _, known, lost, kp_rise = heard([first] + [0.0] * 60, others=0.2)
        assert known.all() and not lost.any() and not kp_rise.any()


def test_joints_become_as_stiff_as_is_safe_and_soft_again_slowly():
    """By half a second after a sensor is lost: kp 20 to 50; a joint loop of more keeps its own."""
    _, _, lost, kp_rise = heard([3.0] + [0.0] * 160 + [3.0] * 160)
    first, last = np.flatnonzero(lost)[[0, -1]]
    assert not kp_rise[:first].any()
    np.testing.assert_allclose(kp_rise[first : first + 100], np.arange(1, 101) / 100, rtol=1e-5)
    np.testing.assert_allclose(kp_rise[last + 1 : last + 101], 1 - np.arange(1, 101) / 100, atol=1e-5)
    kp, safe = jnp.array([[20.0, 80.0]]), jnp.array(50.0)
    np.testing.assert_allclose(sensor_watch.raised_kp(kp, safe, jnp.asarray(0.25)), [[27.5, 80.0]])


class Shy(mc.Law):
    """A law of one's own, that lowers the base by what is measured to push it up."""

    softness: jax.Array = mc.gain("m/N", length=1, bounds=(1e-6, 1e-2), default=1e-4)

    def init(self, start):
        return ()

    def step(self, state, measured, reference):
        down = jnp.zeros_like(measured.wrench).at[2].set(-self.softness * measured.wrench[2])
        return state, mc.control.shifted(reference, down)


LAWS = {
    "Eq. 3": ({}, None),
    "measured pose": ({"control.reading": "measured_pose", "control.damping": 900.0, "control.stiffness": 2e5}, None),
    "Eq. 2": ({"control.controller": "end_effector_admittance"}, None),
    "sum": ({}, mc.control.combined(mc.control.VirtualModelAdmittance(), mc.control.LoadTransfer())),
    "own": ({}, Shy(softness=1e-4)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.nightly] * (n not in ("Eq. 3", "own"))) for n in LAWS]
)
def test_every_law_that_reads_forces_is_looked_after(name):
    """Once lost, said by the walk, no force moves base or feet, and the joints hold as those of the safe kp."""
    changes, law = LAWS[name]
    scenario = mc.load_scenario("case_1_1", WALK | changes)
    walk = mc.rollout(scenario, law=law)
    assert walk.lost_sensors == {"RH": pytest.approx(0.2, abs=0.01)}
    shift = np.where(walk.support[..., None], walk.foot_target - walk.grip_point, 0.0).max((1, 2))
    off, before = shift if name == "Eq. 2" else np.abs(walk.base_displacement).max(1), walk.time < 0.2
    assert off[before].max() > 1e-6
    if name != "measured pose":  # which goes on from where the base is
        assert off[-1] < 0.05 * off[before].max()
    soft = mc.rollout(scenario.with_overrides({"control.safe_kp": None}), law=law)
    np.testing.assert_array_equal(walk.joint_angles[before], soft.joint_angles[before])
    sag = walk.base_reference[-1, 2] - np.array([walk.base_position[-1, 2], soft.base_position[-1, 2]])
    assert 0 < sag[0] < 0.8 * sag[1]


@pytest.mark.slow
def test_pd_needs_no_sensor():
    walk = mc.rollout(mc.load_scenario("case_1_1", WALK | {"control.controller": "pd", "duration": 0.4}))
    assert walk.lost_sensors == {}
