"""Windows: none runs through a hole of the commands, and what follows one begins anew."""

import dataclasses
import types

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.robot_import.load import load_robot
from tests.tuning.identification.recorded import ROBOT, recorded
from tuning.identification.fit.problem import Problem
from tuning.identification.model.predicted import model_of
from tuning.identification.model.windows import KINDS, SHORTEST, Windows, cut
from tuning.identification.readers.log import OFF, Log, Signal

STEP, LATE = 1e-3, 0.02  # s
HOLES = [(2.0, 2.4), (5.5, 5.56)]


def logged(lost=(), kinds=("command", "position"), rate=100.0, jitter=0.0):
    """Return a log of ten seconds, without the samples inside the holes `lost` of the kinds of signals."""
    columns = recorded(rate)
    time = columns.pop("time")
    time = time + jitter / rate * np.random.default_rng(0).uniform(-0.5, 0.5, len(time))
    there = (
        np.all([(time <= start) | (time >= end) for start, end in lost], axis=0) if lost else np.full(len(time), True)
    )
    of = {name: there if name.endswith(kinds) else np.full(len(time), True) for name in columns}
    return Log({name: Signal(time[of[name]], value[of[name]]) for name, value in columns.items()}, "log.csv")


# every tenth row comes 1.8 periods after the one before
LATE_ROWS = np.cumsum(np.where(np.arange(1000) % 10, 0.01, 0.018))


def held(log):
    """Return a log whose commands stay the same."""
    signals = {n: Signal(s.time, 0 * s.value) if n.endswith("command") else s for n, s in log.signals.items()}
    return dataclasses.replace(log, signals=signals)


def sampled(windows):
    """Return when the samples of the windows were taken, s, and the beginning of each one's window."""
    rows, begin = windows.rows, windows.begin[windows.rows.window]
    return begin + (rows.step + rows.share) * windows.time_step, begin


@pytest.mark.parametrize("kinds", [("command", "position"), ("command",)], ids=["rows lost", "commands lost"])
def test_no_window_runs_through_a_hole_of_the_commands(kinds):
    windows = cut(logged(HOLES, kinds), ROBOT, STEP, 0.0, late=LATE)
    np.testing.assert_allclose(windows.unknown, [(start + 0.01, end) for start, end in HOLES], atol=1e-9)
    time, begin = sampled(windows)
    for start, end in HOLES:
        assert not ((begin < end) & (time > start + 0.011)).any()
        assert not ((time > start + 0.011) & (time < end + LATE - STEP)).any()
        after = windows.begin[windows.begin > start]
        assert after[0] == pytest.approx(end + LATE, abs=0.011)
        assert not windows.abuts[windows.begin > start][0]
    assert time[0] >= LATE - STEP  # commands before the log's first are unknown too
    whole = cut(logged(), ROBOT, STEP, 0.0, late=LATE)
    assert len(windows.rows.value) > 0.9 * len(whole.rows.value)


@pytest.mark.parametrize(("kinds", "pauses"), [(("command", "position"), [0]), (("command",), [])])
def test_a_silence_of_all_signals_is_a_pause_in_which_no_command_is_missing(kinds, pauses):
    windows = cut(logged(HOLES, kinds), ROBOT, STEP, 0.0, late=LATE)
    np.testing.assert_allclose(windows.pauses, np.reshape([HOLES[n] for n in pauses], (-1, 2)), atol=1e-9)
    missing = [(start + 0.01, end) for n, (start, end) in enumerate(HOLES) if n not in pauses]
    np.testing.assert_allclose(windows.missing, missing, atol=1e-9)


@pytest.mark.parametrize(("log", "why"), [
    (logged(HOLES, ("position",)), "measurements alone are lost"),
    (logged(jitter=0.8), "jitter"),
    (logged(rate=1000.0 / 12), "another rate"),
    (Log({n: Signal(s.time.round(2), s.value) for n, s in logged(rate=75.0).signals.items()}, ""), "rounded times"),
    (Log({n: Signal(LATE_ROWS, s.value) for n, s in logged().signals.items()}, ""), "a loop that comes late"),
    (held(logged(HOLES, ("command",))), "goals that stay the same"),
])  # fmt: skip
def test_there_is_no_hole_where_no_command_is_missing(log, why):
    assert not len(cut(log, ROBOT, STEP, 0.0).unknown), why


def test_with_the_torque_off_no_command_is_missing():
    log = logged(HOLES[:1], ("command",))
    time = log.signals["LF.coxa.position"].time
    off = Signal(time, ((time > 2.0) & (time < 2.4)) * 1.0)
    assert not len(cut(dataclasses.replace(log, signals={**log.signals, OFF: off}), ROBOT, STEP, 0.0).unknown)


def test_a_log_of_holes_alone_is_refused():
    holes = [(start, start + 0.05) for start in np.arange(0.1, 10, 0.15)]
    with pytest.raises(mc.ConfigError, match=r"expected two seconds or more without gaps, got 0.* missing in 66 holes"):
        cut(logged(holes), ROBOT, STEP, 0.0)


def test_a_signal_that_never_changes_is_not_predicted():
    log = logged()
    still = {"LF.coxa.position": Signal(log.signals["LF.coxa.position"].time, np.full(1000, 0.3))}
    windows = cut(dataclasses.replace(log, signals=log.signals | still), ROBOT, STEP, 0.0)
    assert windows.constant == ("LF.coxa.position",) and "LF.coxa.position" not in windows.names


def test_what_is_held_out_behind_a_hole_is_predicted_from_its_own_first_samples():
    windows = cut(logged([(8.5, 8.9)]), ROBOT, STEP, 0.2, late=LATE)
    fit = Problem(model_of(mc.Scenario(), windows, []), np.ones(len(windows.names)))
    time, begin = sampled(windows)
    placed = fit.fitted & windows.held_out[fit.rows.window]
    assert placed.any() and (time[placed] - begin[placed] < SHORTEST).all()
    assert (~fit.predicted == fit.fitted).all()
    np.testing.assert_allclose(begin[placed].min(), 8.9 + LATE, atol=0.011)


def test_the_search_begins_with_each_window_as_the_log_has_it_and_sees_nothing_that_is_held_out():
    windows = cut(logged([(8.5, 8.9)]), ROBOT, STEP, 0.2, late=LATE)
    pieces = model_of(mc.Scenario(), windows, []).in_pieces
    fit = Problem(pieces, np.ones(len(windows.names)))
    assert not pieces.windows.abuts.any() and not pieces.guess.size and not pieces.states
    assert not (fit.fitted & windows.held_out[fit.rows.window]).any()
    np.testing.assert_array_equal(pieces.logged[..., :2], windows.start)


def test_a_fit_is_compiled_for_a_robot_by_the_contents_of_its_files(tmp_path):
    """An edited file, or one that it includes, gave the answer for the old robot where programs were kept."""
    rod = '<mujoco><body name="rod"><joint name="swing" axis="0 1 0"/>{}</body></mujoco>'
    mass = '<inertial pos="0 0 -0.1" mass="{}" diaginertia="1e-6 1e-6 1e-6"/>'
    (tmp_path / "bench.xml").write_text('<mujoco><worldbody><include file="rod.xml"/></worldbody></mujoco>')
    config = {"robot": {"file": str(tmp_path / "bench.xml"), "limbs": {"rod": {"joints": ["swing"]}}}}

    def compiled_for(kilogram):
        (tmp_path / "rod.xml").write_text(rod.format(mass.format(kilogram)))
        scenario = mc.Scenario().with_overrides(config)
        return model_of(scenario, windows, []).structure

    time = np.arange(300) / 100
    signals = {f"rod.swing.{kind}": Signal(time, np.sin(time)) for kind in ("command", "position")}
    (tmp_path / "rod.xml").write_text(rod.format(mass.format("0.5")))
    windows = cut(Log(signals, "log.csv"), load_robot(mc.Scenario().with_overrides(config).robot), STEP, 0.0)
    first, edited, again = (compiled_for(kilogram) for kilogram in ("0.5", "0.75", "0.5"))
    assert first == again and first != edited


def test_holes_of_the_commands_in_pauses_are_not_missing_and_stamps_of_rates_count_half_a_step_earlier():
    """Second implementations at random: holes and pauses by pairs, stamps by a sorted list."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        begins = np.sort(rng.uniform(0, 9, 4))
        holes = np.stack([begins, begins + rng.uniform(0, 1, 4)], axis=1)
        off = rng.choice([-0.06, 0.06, 0.15], (2, 2))
        pauses = np.stack([holes[1:3, 0] + off[0], holes[1:3, 1] - off[1]], axis=1)
        holes = np.append(holes, [[20.0, 20.2], [20.23, 20.29]], axis=0)  # the second one lies beside the pause
        pauses = np.append(pauses, [[19.99, 20.2]], axis=0)
        inside = [any(c < b and a < d and a > c - 0.1 and b < d + 0.1 for c, d in pauses) for a, b in holes]
        assert inside[-2:] == [True, False]
        seen = types.SimpleNamespace(unknown=holes, pauses=pauses)
        np.testing.assert_array_equal(Windows.missing.fget(seen), holes[~np.array(inside)])
        rows = types.SimpleNamespace(
            stamp=rng.integers(0, 6, 30), step=rng.integers(0, 9, 30), share=rng.uniform(size=30),
            signal=rng.integers(0, 3, 30), window=rng.integers(0, 2, 30),
        )  # fmt: skip
        log = types.SimpleNamespace(rows=rows, kind=np.array([0, 1, 2]), begin=np.array([0.5, 3.0]), time_step=0.01)
        times = []
        for stamp in range(6):
            row = [*rows.stamp].index(stamp)
            early = 0.5 if KINDS[log.kind[rows.signal[row]]] == "velocity" else 0.0
            times.append(log.begin[rows.window[row]] + 0.01 * (rows.step[row] + rows.share[row] - early))
        assert Windows.stamp_spacing.fget(log) == pytest.approx(np.median(np.diff(times)))
