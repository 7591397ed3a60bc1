"""Units, signs, stale repeats, whole turns and outliers of a few samples, each threshold from both sides."""

import numpy as np
import pytest

from mjx_climb.robot_import.load import load_robot
from tuning.identification.readers.log import Signal
from tuning.identification.readers.outliers import without_outliers
from tuning.identification.readers.repairs import cleaned, increasing, without_turns, without_unmeasured
from tuning.identification.readers.signals import Signals, Source

ROBOT = load_robot("hubrobo_v3_2")
TURN = 2 * np.pi
ANGLE, COMMAND = "LF.coxa.position", "LF.coxa.command"


def signal(*values):
    return Signal(0.01 * np.arange(len(values)), np.array(values, float))


def kept(name, *values):
    """The samples of one signal that are no stale repeats."""
    return list(cleaned({name: (signal(*values), "a")}, Signals())[0][name].value)


@pytest.mark.parametrize(("unit", "factor"), [
    (None, 1.0), ("rad", 1.0), ("deg", 0.017453292519943295), ("mm", 0.001), ("m", 1.0), ("rad/s", 1.0),
    ("deg/s", 0.017453292519943295), ("rpm", 0.10471975511965977), ("m/s", 1.0), ("mm/s", 0.001), ("N m", 1.0),
    ("mN m", 0.001), ("kgf cm", 0.0980665), ("N", 1.0), ("mN", 0.001), ("kgf", 9.80665), ("N m/rad", 1.0), ("1", 1.0),
    ("counts", TURN / 4096), ("counts/s", TURN / 4096), ("A", 0.5), ("mA", 0.0005),
])  # fmt: skip
def test_a_number_is_so_much_of_its_si_unit(unit, factor):
    source = Source(column="a", unit=unit, counts_per_turn=4096, torque_constant=0.5)
    assert source.factor == pytest.approx(factor, rel=1e-12)
    assert source.model_copy(update={"sign": -1}).factor == -source.factor


@pytest.mark.parametrize(("how", "number", "signed"), [
    ({"bits": 16}, 32767, 32767), ({"bits": 16}, 32768, -32768), ({"bits": 16}, 65527, -9),
    ({"sign_bit": 10}, 1023, 1023), ({"sign_bit": 10}, 1024, 0), ({"sign_bit": 10}, 1033, -9), ({}, 65527, 65527),
])  # fmt: skip
def test_a_number_has_the_sign_of_its_highest_bit(how, number, signed):
    assert Source(column="a", **how).signed(np.array([float(number)])) == [signed]


def test_times_increase_beyond_all_before_them():
    found = increasing(Signal(np.array([0.0, 2.0, 1.0, 2.0, 1.5, 3.0, 3.0]), np.arange(7.0)))
    np.testing.assert_array_equal(found.value, [0, 1, 5])


UP = [1, 1, 1, 2, 2, 2, 5, 5, 5, 8, 8, 8]  # each reading three times, first by a step of the encoder
ON = [4, 4, 4, 7, 7, 7, 10, 10, 10, 11, 11, 11]  # by such a step at last


@pytest.mark.parametrize(("values", "left"), [
    ([*UP, 11, 11, 11], [1, 1, 1, 2, 5, 8, 11]),
    ([*UP, *15 * [11], 14, 14, 14], [1, 1, 1, 2, 5, 8, 11, 14]),  # 5 times as long as most
    ([*UP, *16 * [11], 14, 14, 14], [1, 1, 1, 2, 5, 8, *16 * [11], 14]),  # longer: at rest
    ([*3 * [1], *ON], [1, 4, 7, 10, 10, 10, 11, 11, 11]),
    ([*6 * [1], *ON], [1, 4, 7, 10, 10, 10, 11, 11, 11]),  # twice as long as the others, at first
    ([*7 * [1], *ON], [*7 * [1], 4, 7, 10, 10, 10, 11, 11, 11]),
    ([1, 1], [1, 1]),
    ([1, 1, 4], [1, 1, 4]),
])  # fmt: skip
def test_repeats_are_stale_unless_the_robot_is_at_rest(values, left):
    assert kept(ANGLE, *values) == left
    assert kept(COMMAND, *values) == values  # one that is sent stays the same
    assert kept("LF.force.x", *values) == left
    assert kept("LF.force.x", *np.zeros(3), *values)[:3] == [0, 0, 0]  # in the air


@pytest.mark.parametrize(("value", "left"), [
    ([0, 1, 1, 2, 3, 4, 5], 7),  # by a step of the encoder
    ([0, 3, 3, 6, 9, 9.5, 12], 6),
    ([0, 3, 3, 6, 9, 10.2, 12], 6),  # 2.5 of its steps and more
    ([0, 3, 3, 6, 9, 10.3, 12], 7),  # less than that
    ([0, 3, 6, 6, 3, 0, 0.5], 7),  # turns round
    ([0, 3, 6, 6, 9, 6, 5.5], 6),
    ([12, 9, 6, 6, 3, 0, -0.5], 6),
])  # fmt: skip
def test_a_single_repeat_is_stale_where_it_moves_by_more_than_steps_of_an_encoder_and_onwards(value, left):
    assert len(kept(ANGLE, *value)) == left


def test_joints_feet_and_base_of_a_message_are_stale_each_by_themselves():
    still, moves = [1, 4, 4, 7, 11, 12, 16], [1, 4, 6, 7, 11, 12, 16]
    given = {
        ANGLE: still, "LF.femur.position": moves, "LF.force.x": still, "LF.force.y": np.zeros(7),
        "base.position.x": still, "base.force.x": still, "base.moment.x": still,
    }  # fmt: skip
    found, said = cleaned({name: (signal(*values), "a") for name, values in given.items()}, Signals())
    dropped = {name for name in given if len(found[name].value) == 6}
    assert dropped == {"LF.force.x", "LF.force.y", "base.position.x"}
    words = "1 of 7 samples repeat the one before to the last bit: suspected to be stale, dropped"
    assert [line.partition(" (")[0] for line in said] == [f"LF.force.x and 2 more: {words}"]


@pytest.mark.parametrize(("values", "found"), [
    ([3.0, 3.1, 3.1 - TURN, 3.2 - TURN], [3.0, 3.1, 3.1, 3.2]),
    ([-3.0, 3.2, 3.1], [-3.0, 3.2 - TURN, 3.1 - TURN]),
    ([0.0, 3.1, 6.2, 6.4], None),  # no jumps
    ([0.0, 3.2, 6.4, 6.4 - TURN], None),  # moves by more than a turn: it is not cut at turns
    ([3.0, 3.0 - TURN + 0.9, 3.0], [3.0, 3.9, 3.0]),  # moved by up to 1 rad beside its jump
    ([3.0, 3.0 - TURN + 1.1, 3.0], None),
])  # fmt: skip
def test_angles_that_are_cut_at_whole_turns_become_continuous(values, found):
    read, said = without_turns({ANGLE: signal(*values)}, ROBOT)
    np.testing.assert_allclose(read[ANGLE].value, values if found is None else found, atol=1e-12)
    jumps = [] if found is None else np.flatnonzero(np.abs(np.diff(values)) > 3)
    assert list(said) == [
        f"{ANGLE}: {len(jumps)} jumps of 2 pi between neighbours, unwrapped (turns: keep in signals.yaml keeps them)"
    ] * (found is not None)


@pytest.mark.parametrize(("off", "few", "mended"), [
    (TURN, 0, True), (-2 * TURN, 0, True), (TURN + 0.9, 0, True), (TURN + 1.1, 0, False), (TURN / 2 - 0.1, 0, False),
    (TURN, 9, True), (TURN, 11, False), (0.0, 0, False),
])  # fmt: skip
def test_a_position_whole_turns_off_its_command_is_brought_back(off, few, mended):
    command = np.sin(np.arange(100) / 30)
    position = command + off + np.where(np.arange(100) >= 100 - few, 1.5, 0.0)  # a few samples lag behind
    read, said = without_turns({COMMAND: signal(*command), ANGLE: signal(*position)}, ROBOT)
    whole = TURN * round(off / TURN) if mended else 0.0
    np.testing.assert_allclose(read[ANGLE].value, position - whole, atol=1e-12)
    assert bool(said) == mended


@pytest.mark.parametrize(("moves", "effort", "left_out"), [
    (0.021, 0.0, True), (0.019, 0.0, False), (0.021, 1e-99, False), (0.021, 0.9e-100, True),
])  # fmt: skip
def test_what_is_0_all_along_while_its_joint_moves_is_not_measured(moves, effort, left_out):
    read = {COMMAND: signal(0, moves, 0), ANGLE: signal(1, 1, 1), "LF.coxa.effort": signal(0, effort, 0)}
    found, said = without_unmeasured(read, ROBOT)
    assert ("LF.coxa.effort" not in found) == left_out
    assert said == ("LF.coxa.effort: 0 all along while the joint moves, not measured: left out",) * left_out


def slope(count=40, **jumps):
    """An angle that grows by 0.01 rad a sample, with other values at some places."""
    values = 1.0 + 0.01 * np.arange(count)
    for place, value in jumps.items():
        values[int(place[1:])] = value
    return values


def beside_0(distance):
    """One that passes a reading of 0 at this distance."""
    values = slope() - slope()[19] + distance
    values[20] = 0
    return values


def to_and_fro(times):
    values = slope()
    values[11 : 11 + 2 * times : 2] = 3.0
    return values


def dropped(values, name=ANGLE):
    """Which samples are outliers."""
    read = {name: signal(*values)}
    left = without_outliers(read, ROBOT, Signals(outliers="drop", signals={name: Source(column="a")}))[0][name]
    return sorted({*range(len(values))} - {*np.round(left.time / 0.01).astype(int).tolist()})


@pytest.mark.parametrize(("values", "out"), [
    (slope(), []),
    (slope(_20=0), [20]),
    (slope(_0=0), []),  # it may begin there
    (slope(_39=0), []),
    (slope(_20=0, _21=0, _22=0), [20, 21, 22]),
    (slope(_20=0, _21=0, _22=0, _23=0), []),  # longer: at rest there
    (beside_0(0.052), [20]),
    (beside_0(0.048), []),  # as near to 0 as the others move
    (beside_0(0.2) + 0.1 * (np.arange(40) > 21), []),  # or as it does here alone
    (beside_0(0.2) + 0.1 * (np.arange(40) > 24), [20]),
    (slope(_20=2.5), [20]),
    (slope(_20=1.25), []),  # 0.05 rad away, neighbours 0.02 apart
    (slope(_20=1.45), [20]),
    (slope(_20=1.39), []),  # within 10 usual changes of two samples
    (slope(_20=2.5, _21=2.5), []),  # stays there
    (slope(_20=2.5)[17:24], [3]),
    (slope(_20=2.5)[19:21], []),  # too short to tell
    (np.where(np.arange(40) % 5 == 2, 3.0, slope()), list(range(2, 39, 5))),
    (to_and_fro(6), list(range(11, 22))),
    (to_and_fro(7), []),  # so many are another's
])  # fmt: skip
def test_samples_far_from_both_beside_them_are_outliers(values, out):
    assert dropped(values) == out


def test_a_quaternion_jumps_and_a_rate_of_0_is_one_unless_its_whole_message_is():
    assert dropped(slope(_20=2.5), "base.orientation.w") == [20]
    names = [ANGLE, "LF.femur.position", "LF.coxa.velocity"]
    values = np.stack([slope(_20=0), slope(_20=0), slope(_10=0, _20=0)])
    signals = Signals(outliers="drop", signals={name: Source(column="a") for name in names})
    read, _ = without_outliers({n: signal(*v) for n, v in zip(names, values, strict=True)}, ROBOT, signals)
    assert [len(read[name].value) for name in names] == [39, 39, 39]
    assert read["LF.coxa.velocity"].value[10] == 0


@pytest.mark.parametrize(("values", "out"), [
    ((slope(_20=0), slope(_20=0)), [20]),
    ((slope(_20=0), slope()), []),  # one alone passes 0
    ((slope(_20=0),), []),
    ((slope(_20=0), 0.3 * (slope() - slope()[20])), [20]),
    ((np.where(np.arange(40) < 20, 0.0, slope()),) * 2, []),  # sets out
    ((slope(_20=0, _21=0, _22=0, _23=0),) * 2, []),  # at rest
])  # fmt: skip
def test_rates_of_0_in_all_joints_between_others_are_not_measured(values, out):
    names = ["LF.coxa.velocity", "LF.femur.velocity"][: len(values)]
    signals = Signals(outliers="drop", signals={name: Source(column="a") for name in names})
    read, _ = without_outliers({n: signal(*v) for n, v in zip(names, values, strict=True)}, ROBOT, signals)
    for name in names:
        assert [n for n in range(40) if n / 100 not in read[name].time.round(6)] == out
