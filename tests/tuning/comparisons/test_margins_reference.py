"""Margins against a second program: every value that is walked, and the last good one, counted one by one."""

import math

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.model import MAX_DELAY
from tuning.comparisons import linear_margins, margins, stability_limit
from tuning.problem.evaluation import RIGID

STEP = 1e-3
GAINS = mc.Gains(1.0, 150.0, 3e3, kp=np.asarray(20.0), kd=np.asarray(0.1))


def values_of(name, own, worst):
    """The values that are walked: even in the root, or in the ratio; the hardware's and twice it are among them."""
    if name == "joint_gains":
        found = [own * (worst / own) ** (k / 15) for k in range(16)]
        wanted = [own, own / 2]
    else:
        longest = max(min(worst, 0.06) if name != "control_period" else worst, 4 * own)
        found = [longest * (k / 15) ** 2 for k in range(16)]
        wanted = [own, own * 2]
    for value in wanted:
        if min(found) <= value <= max(found):
            found[min(range(16), key=lambda k: abs(found[k] - value))] = value
    if name.endswith("_delay"):
        found = [min(value, MAX_DELAY * STEP) for value in found]
    return stepped(name, found)


def stepped(name, values):
    if name != "control_period":
        return list(values)
    return [max(round(value / STEP), 1) * STEP if value else 0.0 for value in values]


def first_bad(values, good):
    return next((k for k, value in enumerate(values) if not good(value)), len(values))


def margin_of(name, coarse, good_of):
    """The last value before the first bad one, by each of two rules, on the grid and a finer one of both."""
    finer = []
    for good, points in zip(good_of, (8, 7), strict=True):
        bad = min(max(first_bad(coarse, good), 1), 15)
        low, high = coarse[bad - 1], coarse[bad]
        finer += [low + (high - low) * (k + 1) / (points + 1) for k in range(points)]
    finer = stepped(name, [*finer, coarse[-1]])
    whole = sorted([*coarse, *finer], reverse=name == "joint_gains")
    counts = [first_bad(whole, good) for good in good_of]
    return [whole[count - 1] if count else None for count in counts], whole


@pytest.mark.parametrize("seed", range(6))
def test_margins_are_those_of_a_second_program(seed, monkeypatch, case):
    """Hardware and limits at random: gains fail in a band and hold beyond it, pay up to a value, and pd fails too."""
    rng = np.random.default_rng(seed)
    own = {"force_delay": rng.uniform(0, 0.02), "command_delay": [0.0, 0.07, 0.15][seed % 3], "control_period": 0.004}
    own["control_period"] = [0.004, 0.0, 0.02, 0.06][seed % 4]
    keys = ("hardware.force_sensor.delay", "hardware.command_delay", "hardware.control_period")
    scenario = case("case_1_2", "virtual_model", dict(zip(keys, own.values(), strict=True)) | {"control.kp": 50.0})
    worst = {"force_delay": 0.03, "command_delay": 0.03, "control_period": 0.05, "joint_gains": 0.05}
    own = {**own, "control_period": own["control_period"] or STEP, "joint_gains": 1.0}
    grids = {name: values_of(name, own[name], worst[name]) for name in own}
    at = {name: grid[rng.integers(2, 14)] * rng.uniform(0.98, 1.02) for name, grid in grids.items()}
    pays = {name: grid[rng.integers(2, 15)] * rng.uniform(0.98, 1.02) for name, grid in grids.items()}
    falls = {name: 1.01 * grid[rng.integers(8, 15)] for name, grid in grids.items()}  # of pd

    def beyond(name, value, limit):
        return value < limit if name == "joint_gains" else value > limit

    def held(name, value):
        end = at[name] / 1.2 if name == "joint_gains" else 1.2 * at[name]
        return not beyond(name, value, at[name]) or beyond(name, value, end)

    def better(name, value):
        return held(name, value) and (not beyond(name, value, pays[name]) or beyond(name, value, falls[name]))

    def walked(scenario, gains, parameters, *, law, metrics, **_):
        loop, bus = parameters.joint_loop, parameters.bus
        columns = [parameters.force_sensor.delay, bus.command_delay, bus.control_period, loop.kp]
        shape = np.broadcast_shapes(*map(np.shape, columns))
        pd = isinstance(law, PD) or (isinstance(gains, mc.Gains) and np.all(gains.inertia == RIGID))
        force, detached, diverged = np.full(shape, 100.0), np.full(shape, np.nan), np.zeros(shape, bool)
        for row, (name, column) in enumerate(zip(own, columns, strict=True)):
            for k in range(shape[1]):
                value = np.broadcast_to(column, shape)[row, k]
                if pd:
                    diverged[row, k] = beyond(name, value / (50.0 if name == "joint_gains" else 1), falls[name])
                    continue
                value = value / (20.0 if name == "joint_gains" else 1)
                force[row, k] = 200.0 if beyond(name, value, pays[name]) else 50.0
                lost = not held(name, value)
                detached[row, k], diverged[row, k] = (1.0 if lost and k % 2 else np.nan), lost and not k % 2
        return {"force_variation": force, "detached_at": detached, "diverged": diverged}

    monkeypatch.setattr(mc, "rollout_metrics", walked)
    told = []
    found = margins.find(scenario, GAINS, progress=lambda *now: told.append(now))
    assert told == [(64, 256), (128, 256), (192, 256), (256, 256)]
    for name, grid in grids.items():
        good_of = [lambda value, name=name: held(name, value), lambda value, name=name: better(name, value)]
        wanted, whole = margin_of(name, grid, good_of)
        np.testing.assert_allclose(found.walks["value"].sel(quantity=name), whole, rtol=1e-9, atol=1e-15)
        margin = found.margins[name]
        for reached, value in zip((margin.holds, margin.better), wanted, strict=True):
            assert reached == (value if value is None else pytest.approx(value, rel=1e-9))
        assert (margin.own, margin.worst) == pytest.approx((own[name], grid[-1]))
        assert margin.unit == ("x" if name == "joint_gains" else "s")
        assert margin.needed == (0.5 if name == "joint_gains" else 2 * own[name])
    assert found.holds == held("force_delay", own["force_delay"])
    assert found.better == better("force_delay", own["force_delay"])


ASKED = {"control_period": (0.02, 0.03, 0.05), "force_delay": (4e-3, 9e-3, 0.03), "joint_gains": (1.0, 0.3, 0.05)}


@pytest.mark.parametrize("name", ASKED)
@pytest.mark.parametrize("reached", ["walks", "beyond", "none"])
def test_linear_margins_are_looked_for_half_as_far_again_as_walks_hold(name, reached, monkeypatch, case):
    """A loop whose worst stance is another one on either side, stable up to a known value."""
    own, holds, worst = ASKED[name]
    holds = {"walks": holds, "beyond": worst, "none": None}[reached]
    keys = {"control_period": "hardware.control_period", "force_delay": "hardware.force_sensor.delay"}
    scenario = case("case_1_2", "virtual_model", {keys[name]: own} if name in keys else {})
    down, limit = name == "joint_gains", {"control_period": 0.0263, "force_delay": 6.21e-3, "joint_gains": 0.41}[name]
    asked = []

    def radii(scenario, gains, parameters, *, only, hardware, law, engine):
        values = {"control_period": parameters.bus.control_period, "force_delay": parameters.force_sensor.delay}
        value = np.reshape(values.get(name, parameters.joint_loop.kp / 20.0), (-1, 1))
        asked.append((np.ravel(value), only))
        assert hardware == stability_limit.HARDWARE and gains.kp is None
        far = (limit - value if down else value - limit) * np.array([1.0, 30.0, 2.0])
        return (1 + far)[:, slice(None) if only is None else [only]]

    monkeypatch.setattr(stability_limit, "by_stance", radii)
    told = []
    margin = {name: margins.Margin(own, holds, holds, worst, unit="x" if down else "s")}
    found = linear_margins.find(scenario, GAINS, margin, progress=lambda *now: told.append(now))[name]
    grid = margins.QUANTITIES[name].values(own_parameters(scenario), scenario.time_step)
    there = (min if down else max)(grid[4], grid[0] if holds is None else holds)
    tried = max(worst, there / 1.5) if down else min(worst, there * 1.5)
    first, only = asked[0]
    assert only is None and first.size == 9 and told == [(1, 1)]
    spaced = [grid[0] * (tried / grid[0]) ** (k / 8) if down else grid[0] + (tried - grid[0]) * k / 8 for k in range(9)]
    np.testing.assert_allclose(first, stepped(name, spaced), rtol=1e-12)
    assert found.tried == pytest.approx(first[-1])
    if (first[-1] < limit) != down:
        assert found.up_to == first[-1]
    elif name == "control_period":
        assert found.up_to == pytest.approx(0.026)
    else:
        assert found.up_to == pytest.approx(limit, rel=2e-3) and (found.up_to < limit) != down
    assert {stance for _, stance in asked[1:]} <= {None, 1}


@pytest.mark.parametrize(
    ("unit", "value", "text"),
    [("s", 7.0312e-3, "7.03 ms"), ("x", 0.0512, "x 0.051"), ("N", 1.2345, "1.23 N"), ("1", 1.4142, "1.41")],
)
def test_margins_in_words(unit, value, text):
    margin = margins.Margin(1.0, 2.0, None, 3.0, "spread", unit)
    assert margin.with_unit(value) == text
    assert margin.in_words(None) == "none" and margin.in_words(value) == text
    assert margin.in_words(3.0) == margin.with_unit(3.0) + " or more"
    assert margin.in_words(value, value) == text + " or more"
    down = margins.Margin(1.0, 2.0, None, 0.5, "spread", unit)
    assert down.in_words(0.5) == down.with_unit(0.5) + " or less" and down.in_words(value) == text
    # twice, or half, is enough; a little less is not
    for one, enough, short in ((margin, 2.0, 1.99), (down, 0.5, 0.51)):
        assert one.needed == enough and one.falls_short("gains hold", enough) == []
        has = f"the hardware has {one.with_unit(1.0)}, {one.with_unit(enough)} would be safe"
        assert one.falls_short("gains hold", short) == [f"spread: gains hold up to {one.with_unit(short)} only, {has}"]
        assert one.falls_short("gains hold", None) == [f"spread: gains hold at no value, {has}"]
    # gains that hold at the worst value walked may hold at twice their own too
    assert margins.Margin(1.0, 1.5, None, 1.5, "spread", unit).falls_short("gains hold", 1.5) == []


@pytest.mark.parametrize(
    ("holds", "better", "reached", "lines"),
    [
        (False, False, {}, ["on the hardware itself the walk fails: a gripper is torn off, or it diverges"]),
        (True, False, {}, ["on the hardware itself the force varies no less than under pd"]),
        (True, True, {}, []),
        (True, True, {"better": 1.5e-3}, ["a: gains stay better than pd up to 1.5 ms only"]),
        (True, False, {"better": 1.5e-3}, ["on the hardware itself the force varies no less than under pd"]),
        (True, True, {"holds": 1.5e-3, "better": 1.5e-3}, ["a: gains hold up to 1.5 ms only"]),
        (
            True,
            False,
            {"holds": 1.5e-3},
            ["on the hardware itself the force varies", "a: gains hold up to 1.5 ms only"],
        ),
    ],
)
def test_objections_to_gains_by_their_margins(holds, better, reached, lines):
    margin = margins.Margin(1e-3, reached.get("holds", 3e-3), reached.get("better", 3e-3), 4e-3, "a")
    found = margins.warnings(margins.Found({"a": margin}, holds, better, None))
    assert len(found) == len(lines) and all(map(str.startswith, found, lines))


def test_no_lead_on_better_hardware_is_one_line_for_all_quantities():
    """The first value walked may be better than the hardware: on the hardware itself the gains lead."""
    each = {name: margins.Margin(1e-3, 3e-3, None, 4e-3, name) for name in ("force delay", "command delay")}
    found = margins.Found({**each, "c": margins.Margin(1e-3, 3e-3, 3e-3, 4e-3, "c")}, True, True, None, "retuned pd")
    said = "with less force delay or command delay the force varies no less than under retuned pd"
    assert margins.warnings(found) == [said]
    assert [margin.sentence for margin in each.values()] == [f"{name}: holds up to 3 ms" for name in each]
    short = margins.Margin(1e-3, 1.5e-3, None, 4e-3, "force delay")
    lines = margins.warnings(margins.Found({"a": short}, True, True, None, "retuned pd"))
    assert len(lines) == 1 and lines[0].startswith("force delay: gains hold up to 1.5 ms only")


def test_good_points_are_counted_up_to_the_first_that_is_not():
    for good, count in (([], 0), ([True, True], 2), ([False, True], 0), ([True, False, True], 1)):
        assert margins.count_good(np.array(good, bool)) == count
    assert math.isclose(margins.needed(0.004, 0.03), 0.008) and margins.needed(1.0, 0.05) == 0.5
