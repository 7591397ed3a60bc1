"""Spaces of gains, changes by path and drawn hardware, against the same rules written a second time, with loops."""

import contextlib
import itertools
import math

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import EndEffectorAdmittance, VirtualModelAdmittance
from tuning.problem import ensemble, spaces, variations
from tuning.problem.ensemble import Drawn, Ensemble, Hardware
from tuning.problem.search import Search
from tuning.problem.spaces import Space
from tuning.problem.variations import Factor

CASE = mc.load_scenario("case_1_2")
AXES = ("x", "y", "z", "rx", "ry", "rz")
RNG = np.random.default_rng(0)


# --- from settings to a space


def keys(gain, axis, layout):
    """From the general to the particular."""
    every = [gain, f"{gain}.{'translation' if axis < 3 else 'rotation'}", f"{gain}.{AXES[axis]}"]
    return every[: {"isotropic": 1, "split": 2, "diagonal": 3}[layout]]


def drawn_settings(rng):
    """Bounds, pins and frozen keys of which the most particular decides."""
    layout = rng.choice(["isotropic", "split", "diagonal"])
    sections = {"bounds": {}, "pins": {}, "frozen": []}
    for gain in ("damping", "stiffness", "inertia"):
        # one at each level at the most, so that none is without numbers: a whole gain keeps one axis free
        for depth in range({"isotropic": 0, "split": 1, "diagonal": 2}[layout] + 1):
            if rng.uniform() < 0.4:
                key = keys(gain, 2 + depth, layout)[depth]
                section = rng.choice(["bounds", "pins", "frozen"])
                low = float(10 ** rng.uniform(-1, 3))
                if section == "frozen":
                    sections["frozen"].append(key)
                else:
                    sections[section][key] = (low, 30 * low) if section == "bounds" else low
    return {"space": str(layout), "inertia": True, "joint_gains": bool(rng.uniform() < 0.5), **sections}


def wanted_space(settings, own, defaults):
    """The names, bounds, and of each number a name or a value, by loops."""
    named, numbers, used = {}, {}, set()
    every = dict.fromkeys(("inertia", "damping", "stiffness"), 6)
    for gain in [*own, *(["kp", "kd"] if settings["joint_gains"] else [])]:
        numbers[gain] = []
        for axis in range(every.get(gain, 1)):
            levels = keys(gain, axis, settings["space"]) if gain in every else [gain]
            for key in reversed(levels):
                if key in settings["pins"]:
                    used.add(key)
                    numbers[gain].append(settings["pins"][key])
                    break
                if key in settings["frozen"]:
                    used.add(key)
                    numbers[gain].append(own[gain][axis])
                    break
                if key in settings["bounds"]:
                    used.add(key)
                    named[levels[-1]] = settings["bounds"][key]
                    numbers[gain].append(levels[-1])
                    break
            else:
                named[levels[-1]] = next(defaults[key] for key in reversed(levels) if key in defaults)
                numbers[gain].append(levels[-1])
    asked = {*settings["pins"], *settings["frozen"], *settings["bounds"]}
    return named, numbers, asked - used


@pytest.mark.parametrize("seed", range(40))
def test_a_space_is_that_of_its_settings(seed):
    """The most particular key decides; one that decides nothing is refused, as is a space of no numbers."""
    rng = np.random.default_rng(seed)
    settings = drawn_settings(rng)
    values = {name: 10 ** rng.uniform(0, 3, 6) for name in ("inertia", "damping", "stiffness")}
    law = VirtualModelAdmittance(**values)
    bounds = law.search_bounds(CASE.time_step)
    kp, kd = CASE.control.kp, CASE.control.kd
    bounds |= {"kp": (kp / 5, kp * 4), "kd": (kd / 10, kd * 10)}
    named, numbers, unused = wanted_space(settings, values, bounds)
    if unused or not named:
        with pytest.raises(mc.ConfigError, match="no other setting" if unused else "a gain left to search"):
            spaces.space(CASE, Search.make(settings), law)
        return
    space = spaces.space(CASE, Search.make(settings), law)
    assert set(space.names) == set(named) and space.size == len(named) == len(space.names)
    for n, name in enumerate(space.names):
        np.testing.assert_allclose(np.exp([space.lower[n], space.upper[n]]), named[name], rtol=1e-12)
    theta = space.draw(rng, 3)
    gains = vars(space.to_gains(theta))
    for gain, each in numbers.items():
        for row in range(3):
            expected = [np.exp(theta[row, space.names.index(v)]) if isinstance(v, str) else v for v in each]
            np.testing.assert_allclose(np.ravel(gains[gain][row]), expected, rtol=1e-12)
    assert {name for name in gains if gains[name] is not None} == set(numbers)


REFUSED = [
    ({"bounds": {"damping": (0.0, 1.0)}}, "bounds.damping: expected a low end above 0, got 0"),
    ({"bounds": {"kp": (0.0, 1.0)}, "joint_gains": True}, "bounds.kp: expected a low end above 0, got 0"),
    ({"pins": {"kp": 0.0}, "joint_gains": True}, "pins.kp: expected a number above 0, got 0"),
    ({"pins": {"damping": -1.0}}, "pins.damping: expected a number above 0, got -1"),
    ({"pins": {"damping": 0.0}}, "pins.damping: expected a number above 0, got 0"),
    ({"pins": {"damping.x": 1.0}}, "pins.damping.x: expected one of"),
    ({"frozen": ["kp"], "joint_gains": True}, "frozen.kp: expected one of"),
    ({"also": ["wrong"]}, "also: expected gains of the law"),
    ({"pins": {"damping": 1.0}, "frozen": ["stiffness"]}, "pins: expected a gain left to search, got none"),
    # a gain that is not searched may be pinned alone
    ({"bounds": {"inertia": (1.0, 2.0)}}, "bounds.inertia: expected one of damping, stiffness"),
    ({"space": "split", "bounds": {"damping.rotation": (0.0, 1.0)}}, "bounds.damping.rotation: expected a low end"),
]


@pytest.mark.parametrize(("changes", "said"), REFUSED)
def test_settings_of_no_space_are_refused(changes, said):
    with pytest.raises(mc.ConfigError) as refused:
        spaces.space(CASE, Search.make({"joint_gains": False} | changes))
    assert str(refused.value).startswith(said)


def test_bounds_of_joint_loop_and_gait_are_about_the_scenarios_own():
    """By hand: factors, and where the scenario has nothing, a share of kp."""
    for overrides, expected in [
        ({"control.kp": 50.0, "control.kd": 0.0, "control.ki": 0.0}, {"kd": (0.02, 2.0), "ki": (2.5, 250.0)}),
        ({"control.kp": 20.0, "control.kd": 0.3, "control.ki": 7.0}, {"kd": (0.03, 3.0), "ki": (0.7, 70.0)}),
    ]:
        scenario = CASE.with_overrides(overrides)
        space = spaces.space(scenario, Search.make({"joint_gains": True, "also": ["ki", "gait.sway", "gait.height"]}))
        kp = scenario.control.kp
        ends = {
            name: np.exp([low, high]) for name, low, high in zip(space.names, space.lower, space.upper, strict=True)
        }
        for name, pair in (
            expected | {"kp": (kp / 5, 4 * kp), "gait.sway": (0.02, 0.5), "gait.height": (0.85, 1.15)}
        ).items():
            np.testing.assert_allclose(ends[name], pair, rtol=1e-12, err_msg=name)


class Signed(mc.Law):
    """A law with a gain of either sign, and an array."""

    tilt: object = mc.gain("1", bounds=(-3.0, 4.0), default=0.5, length=1)
    share: object = mc.gain("1", bounds=(0.0, 7.0), default=0.0, length=1)
    weights: object = mc.gain("1", shape=(2, 2), bounds=(-1.0, 2.5), default=0.25)
    damping: object = mc.gain("N s/m", length=3, bounds=(1.0, 1e3), default=10.0)

    def init(self, start):
        return ()

    def step(self, state, measured, reference):
        return state, mc.control.shifted(reference, 0 * measured.wrench)


def test_a_gain_of_either_sign_is_a_coordinate_of_its_own_in_sevenths_of_its_bounds():
    """As wide as the logarithm of a factor of a thousand; it may be pinned at zero, and bounded below it."""
    settings = {
        "joint_gains": False,
        "space": "split",
        "bounds": {"weights.1.0": (-0.7, 0.7)},
        "pins": {"weights.0.1": 0.0},
    }
    space = spaces.space(CASE, Search.make(settings), Signed())
    assert space.names == ("tilt", "share", "weights.0.0", "weights.1.0", "weights.1.1", "damping.translation")
    np.testing.assert_allclose(space.units, [1.0, 1.0, 0.5, 0.2, 0.5, 0.0])
    np.testing.assert_allclose(space.lower, [-3.0, 0.0, -2.0, -3.5, -2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(space.upper, [4.0, 7.0, 5.0, 3.5, 5.0, math.log(1e3)])
    gains = space.to_gains(np.array([2.0, 0.0, 1.0, -1.0, 3.0, math.log(30.0)]))
    assert gains["tilt"] == 2.0 and gains["share"] == 0.0
    np.testing.assert_allclose(gains["weights"], [[0.5, 0.0], [-0.2, 1.5]])
    np.testing.assert_allclose(gains["damping"], np.full(3, 30.0))


def test_a_gain_that_is_not_searched_is_held_or_pinned():
    """Inertia: the law's own on each axis, or the value that it is pinned to on all; ki too goes with paper's gains."""
    law = VirtualModelAdmittance(inertia=np.arange(1.0, 7.0))
    for pins, wanted in (({}, np.arange(1.0, 7.0)), ({"inertia": 9.0}, np.full(6, 9.0))):
        settings = Search.make({"joint_gains": False, "also": ["ki"], "pins": pins})
        found = spaces.space(CASE, settings, law)
        gains = found.to_gains(found.lower)
        assert isinstance(gains, mc.Gains) and found.names == ("damping", "stiffness", "ki")
        np.testing.assert_array_equal(gains.inertia, wanted)
    with pytest.raises(mc.ConfigError) as refused:
        spaces.space(CASE, Search.make({"frozen": ["none"]}), Signed())
    # numbers of an array are too many to name
    assert str(refused.value) == "frozen.none: expected one of damping, share, tilt, weights"


@pytest.mark.parametrize(
    ("hardware", "settings", "searched"),
    [
        ({}, {}, []), ({"force_sensor.delay": 0.01}, {}, ["kp", "kd"]), ({}, {"joint_gains": True}, ["kp", "kd"]),
        ({"force_sensor.delay": 0.01}, {"joint_gains": False}, []), ({}, {"also": ["ki"]}, ["ki"]),
        ({"force_sensor.delay": 0.01, "ki": 2.0}, {}, ["kp", "kd", "ki"]),
        ({"ki": 2.0}, {}, ["kp", "kd", "ki"]), ({"ki": 2.0}, {"joint_gains": False}, []),
    ],
)  # fmt: skip
def test_joint_gains_are_searched_where_there_is_hardware_or_where_asked_for(hardware, settings, searched):
    """ki with them, where the scenario has one, which asks for them as hardware does."""
    case = CASE.with_overrides({f"{'control' if n == 'ki' else 'hardware'}.{n}": v for n, v in hardware.items()})
    assert spaces.space(case, Search.make(settings)).names[2:] == tuple(searched)


def test_a_duty_is_searched_above_its_own_least_where_that_is_high():
    """Of nine limbs and more one swing at a time leaves less than the longest stance that is looked at otherwise."""
    for limbs, phases, span in (
        (4, None, (0.75, 0.95)), (12, None, (11 / 12, 23 / 24)), (40, None, (39 / 40, 79 / 80)),
        (40, {}, (CASE.gait.duty, 0.95)),
    ):  # fmt: skip
        gait = CASE.gait.model_copy(update={"sequence": tuple(map(str, range(limbs))), "phases": phases})
        spans = spaces._gait_bounds(CASE.model_copy(update={"gait": gait}))
        assert spans["gait.duty"] == pytest.approx(span)


def test_own_gains_of_a_law_of_translations_have_the_scenarios_rotations():
    """As the paper's gains: six of each, of which the law says three; of another law they are its own."""
    scenario = CASE.with_overrides({"control.damping": [1.0, 2, 3, 4, 5, 6]})
    law = EndEffectorAdmittance(np.full(3, 7.0), np.full(3, 8.0), np.full(3, 9.0))
    found = spaces.own_values(scenario, law)
    np.testing.assert_array_equal(found["damping"], [8, 8, 8, 4, 5, 6])
    assert {name: value.shape for name, value in found.items()} == dict.fromkeys(
        ("inertia", "damping", "stiffness"), (6,)
    )
    own = spaces.own_values(scenario, Signed())
    assert {name: np.shape(value) for name, value in own.items()} == {
        "tilt": (), "share": (), "weights": (2, 2), "damping": (3,)
    }  # fmt: skip


# --- points of a space


def mixed():
    """Coordinates that are logarithms and that are gains themselves, shared or not, and numbers of an array."""
    names = ("damping.x", "damping.rx", "stiffness", "w.0.0", "w.0.1", "w.1.0", "gait.duty", "kp")
    units = np.array([0, 0, 0, 2.0, 2.0, 0.5, 0, 0])
    lower, upper = np.array([-2.0, 0, 1, -3, -3, -1, -0.5, 2]), np.array([3.0, 2, 4, 4, 3, 1, -0.1, 3])
    index = {
        "damping": np.array([0, 0, 8, 1, 9, 1]), "stiffness": np.full(6, 2), "w": np.array([[3, 4], [5, 10]]),
        "gait.duty": np.array(6), "kp": np.array(7),
    }  # fmt: skip
    return Space(names, lower, upper, units, index, np.array([5.0, 6.0, -7.0]))


def test_gains_of_points_their_tangents_and_the_way_back():
    space = mixed()
    theta, along = space.draw(RNG, 4), RNG.normal(size=(3, 8))
    for given in (theta, jnp.asarray(theta[0]), theta[0]):
        found = space.to_gains(given)
        for row in np.ndindex(given.shape[:-1]):
            each = [math.exp(x) if not u else u * x for x, u in zip(np.asarray(given)[row], space.units, strict=True)]
            each += [5.0, 6.0, -7.0]
            for name, index in space.index.items():
                expected = np.reshape([each[place] for place in index.ravel()], index.shape)
                np.testing.assert_allclose(found[name][row], expected, rtol=1e-12, err_msg=name)
    tangents = space.to_tangents(theta, along)
    for k, n in np.ndindex(3, 4):
        sides = [space.to_gains(theta[n] + side * 1e-6 * along[k]) for side in (1, -1)]
        for name in space.index:
            slope = (sides[0][name] - sides[1][name]) / 2e-6
            np.testing.assert_allclose(tangents[name][k, n], slope, rtol=1e-6, atol=1e-7)
    for point in theta:
        np.testing.assert_allclose(space.from_gains(space.to_gains(point)), point, rtol=1e-12)


def test_the_nearest_point_to_gains_is_their_mean_within_the_bounds():
    """Geometric where the coordinate is a logarithm; held numbers count nothing, gains that are not there neither."""
    space = mixed()
    gains = {"damping": np.array([1.0, 4.0, 99.0, 2.0, 99.0, 8.0]), "stiffness": 30.0,
             "w": np.array([[1.0, -2], [3, 9]]),
             "kp": 1.0, "gait.duty": None}  # fmt: skip
    found = dict(zip(space.names, space.from_gains(gains), strict=True))
    expected = {"damping.x": math.log(2), "damping.rx": math.log(4), "stiffness": math.log(30),
                "w.0.0": 0.5, "w.0.1": -1.0,
                "w.1.0": 1.0, "gait.duty": -0.1, "kp": 2.0}  # fmt: skip
    assert found == pytest.approx(expected)


def test_parts_strides_ties_and_bounds_of_coordinates():
    space = mixed()
    assert space.gains == ["stiffness", "damping", "w", "gait.duty", "kp"]
    assert space.smooth.tolist() == [True] * 6 + [False, True]
    assert space.of_arrays.tolist() == [False] * 3 + [True] * 3 + [False] * 2
    assert {name: np.flatnonzero(own).tolist() for name, own in space.parts.items()} == {
        "damping.x": [0], "damping.rx": [1], "stiffness": [2], "w": [3, 4, 5], "gait.duty": [6], "kp": [7]
    }  # fmt: skip
    np.testing.assert_allclose(space.strides, [1, 1, 1, 3**-0.5, 3**-0.5, 3**-0.5, 1, 1])
    ties = [[0, 1], [2], [3], [4], [5], [6], [7]]
    np.testing.assert_array_equal(space.ties, [[n in tie for n in range(8)] for tie in ties])
    theta = (space.lower + space.upper) / 2
    for part, own in space.parts.items():
        before, after = space.to_gains(theta), space.to_gains(space.scaled(theta, 1.5, part))
        moved = {name for name in before if not np.allclose(before[name], after[name])}
        assert moved <= {part.split(".")[0], part}
        places = np.flatnonzero(own)
        for name, index in space.index.items():
            expected = np.where(np.isin(index, places), 1.5, 1.0) * before[name]
            np.testing.assert_allclose(after[name], expected, rtol=1e-12)
    width = space.upper - space.lower
    for n, side in itertools.product(range(8), (0, 1)):
        end = (space.lower, space.upper)[side][n]
        inwards = width[n] * (1 - 2 * side)
        for distance, on in ((0.0, True), (0.9e-3, True), (1.1e-3, False), (-0.1, True)):
            point = np.where(np.arange(8) == n, end + distance * inwards, theta)
            expected = [name for name, own in space.parts.items() if own[n]] if on else []
            assert space.on_bound(point) == expected
    point = np.where(np.arange(8) == 2, space.lower + 0.04 * width, theta)
    assert space.on_bound(point, 0.05) == ["stiffness"] and space.on_bound(point, 0.03) == []
    np.testing.assert_array_equal(space.clip(theta + 100), space.upper)
    np.testing.assert_array_equal(space.clip(theta - 100), space.lower)


def test_points_are_hypercubes_and_tied_ones_have_the_same_gains_as_far_as_bounds_let_them():
    space, count = mixed(), 50
    plain, tied = space.draw(np.random.default_rng(1), count), space.draw_tied(np.random.default_rng(1), count)
    for n in range(8):
        cells = np.floor((plain[:, n] - space.lower[n]) / (space.upper[n] - space.lower[n]) * count)
        assert sorted(cells) == list(range(count))
    assert len(set(map(tuple, np.argsort(plain, axis=0).T))) == 8
    # both have a part of their bounds in common
    np.testing.assert_array_equal(tied[:, 0], tied[:, 1])
    cells = np.floor((tied[:, 0] - 0.0) / 2.0 * count)
    assert sorted(cells) == list(range(count))
    apart = Space(space.names[:2], np.array([0.0, 3.0]), np.array([1.0, 5.0]), np.zeros(2), {}, np.zeros(0))
    np.testing.assert_array_equal(apart.draw_tied(np.random.default_rng(0), 4), [[1.0, 3.0]] * 4)


# --- changes by path


def test_changes_are_values_or_factors_and_periods_are_whole_steps():
    parameters = mc.parameters(CASE.with_overrides({"hardware.force_sensor.bias": 0.3}))
    factor = np.array([[0.5], [2.0]])
    changes = {"contact.stiffness": Factor(factor), "gravity": Factor(factor),
               "hardware.control_period": [2.4e-3, 1e-4, 0],
               "contact.damping": np.array([3.0, 4.0])}  # fmt: skip
    found = variations.changed(parameters, changes, 1e-3)
    np.testing.assert_allclose(found.contact.stiffness, factor * np.asarray(parameters.contact.stiffness))
    np.testing.assert_allclose(found.gravity, factor[..., None] * np.asarray(parameters.gravity))
    np.testing.assert_allclose(found.at("hardware.control_period"), [2e-3, 1e-3, 0.0])
    np.testing.assert_array_equal(found.contact.damping, [3.0, 4.0])
    as_given = variations.changed(parameters, {"hardware.control_period": [2.4e-3]})
    np.testing.assert_array_equal(as_given.at("hardware.control_period"), [2.4e-3])
    for period in np.random.default_rng(0).uniform(0, 5e-3, 50):
        nearest = min((n * 1e-3 for n in range(1, 9)), key=lambda each: abs(each - period))
        assert variations.whole_periods(period, 1e-3) == pytest.approx(nearest)


@pytest.mark.parametrize(
    ("text", "factor"),
    [
        ("x2", 2.0),
        ("x0.5", 0.5),
        ("x1e-3", 1e-3),
        ("2", None),
        ("", None),
        *((t, "refused") for t in ("x0", "x-1", "x", "xx", "xinf", "xnan")),
    ],
)
def test_a_factor_is_written_with_an_x(text, factor):
    if factor == "refused":
        with pytest.raises(ValueError, match="expected a factor above 0"):
            variations.scaled(text)
    else:
        assert variations.scaled(text) == factor


def test_names_of_paths_and_words_for_several():
    parameters = mc.parameters(CASE.with_overrides({"hardware.servo.coulomb_friction": 0.1}))
    assert [*map(variations.is_path, ("contact.stiffness", "damping", "gait.duty", "gravity"))] == [
        True,
        False,
        False,
        False,
    ]
    assert variations.paths_of(parameters, "contact.stiffness") == ["contact.stiffness"]
    friction = variations.paths_of(parameters, "friction")
    assert "hardware.servo.coulomb_friction" in friction and len(friction) > 3
    assert all(path.startswith("hardware.servo.") and path.endswith("friction") for path in friction)
    assert variations.scalable(parameters, [*friction, "none.there"]) == ["hardware.servo.coulomb_friction"]
    assert set(variations.paths_of(parameters, "delay")) == {
        "hardware.force_sensor.delay", "hardware.base_estimate.delay", "hardware.command_delay"
    }  # fmt: skip
    assert set(variations.paths_of(parameters, "noise")) == {
        "hardware.force_sensor.noise", "hardware.base_estimate.position_noise", "hardware.base_estimate.velocity_noise"
    }  # fmt: skip


def test_changes_that_no_walk_can_have_are_refused():
    """At the last value that is allowed, and just beyond."""
    parameters, step = mc.parameters(CASE), CASE.time_step
    delay = "hardware.force_sensor.delay"
    variations.checked(CASE, parameters, {delay: [0.0, 500 * step]}, "draw.{}")
    for changes, said in [
        (
            {delay: [0.0, 500.1 * step, 1.0 * step]},
            f"draw.{delay}: expected at most 500 time steps, {500 * step:g} s, got {500.1 * step:g}",
        ),
        ({delay: -1e-9}, f"draw.{delay}: "),
        (
            {"contact.nothing": 1.0},
            "draw.contact.nothing: expected a value at contact.nothing to change, got Gripper without nothing",
        ),
        ({"nowhere.at": 1.0}, "draw.nowhere.at: expected a value at nowhere.at to change, got none"),
    ]:
        with pytest.raises(mc.ConfigError) as refused:
            variations.checked(CASE, parameters, changes, "draw.{}")
        assert str(refused.value).startswith(said)


def test_robots_of_a_grid_have_their_values_on_all_axes():
    values = {"damping": np.array([1.0, 2.0]), "kp": np.array([3.0, 4.0]), "contact.stiffness": np.array([5e3, 6e3])}
    gains, own = variations.as_walked(CASE, VirtualModelAdmittance(), values)
    assert set(gains) == {"damping", "kp"}
    np.testing.assert_array_equal(gains["damping"], [[1.0], [2.0]])
    np.testing.assert_array_equal(gains["kp"], [3.0, 4.0])
    np.testing.assert_array_equal(own.contact.stiffness, [5e3, 6e3])


# --- drawn hardware


def strata(values, low, high, logs=False):
    """Whether each member has a value, and one falls into each part of a range."""
    values, low, high = (np.log(v) if logs else np.asarray(v) for v in (values, low, high))
    count = np.size(values)
    return count > 1 and sorted(np.floor((np.ravel(values) - low) / (high - low) * count)) == [*range(count)]


def test_hardware_of_members_is_drawn_from_its_ranges():
    """Filters, rates and factors are even in the logarithm; periods whole steps; each member has noise of its own."""
    scenario = CASE.with_overrides(
        {"hardware.servo": {"coulomb_friction": 0.2, "viscous_friction": 0.03, "armature": 1e-3}}
    )
    spans = {"force_delay": (0.001, 0.004), "command_delay": (0.0, 0.002), "force_noise": (0.1, 0.3),
             "force_bias": (-1.0, 2.0),
             "backlash": (0.001, 0.01), "capture_distance": (0.002, 0.02), "force_filter": (10.0, 200.0)}  # fmt: skip
    section = Hardware(**spans, control_rate=(50.0, 500.0), friction=(0.5, 2.0), armature=(0.25, 4.0))
    drawn = ensemble.draw(scenario, Ensemble(members=64, pushes=None, cargo=None, gravity=None, hardware=section))
    paths = {
        "force_delay": "hardware.force_sensor.delay", "command_delay": "hardware.command_delay",
        "force_noise": "hardware.force_sensor.noise", "force_bias": "hardware.force_sensor.bias",
        "backlash": "hardware.servo.backlash", "capture_distance": "contact.capture_distance",
        "force_filter": "hardware.force_sensor.filter",
    }  # fmt: skip
    for name, path in paths.items():
        assert drawn.at(path).shape == (64, 1)
        assert strata(drawn.at(path), *spans[name], logs=name == "force_filter"), name
    steps = drawn.at("hardware.control_period") / CASE.time_step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    # even in the logarithm: half of the rates below their geometric mean
    assert 0.4 < (steps * CASE.time_step > 1 / math.sqrt(50 * 500)).mean() < 0.6
    own = mc.parameters(scenario)
    friction = drawn.at("hardware.servo.coulomb_friction") / float(own.at("hardware.servo.coulomb_friction"))
    assert strata(friction, 0.5, 2.0, logs=True)
    np.testing.assert_allclose(drawn.at("hardware.servo.viscous_friction"), 0.03 * friction, rtol=1e-6)
    assert strata(drawn.at("hardware.servo.armature") / 1e-3, 0.25, 4.0, logs=True)
    np.testing.assert_array_equal(drawn.at("hardware.servo.load_friction"), own.at("hardware.servo.load_friction"))
    seeds = drawn.at("hardware.seed")
    assert seeds.shape == (64, 1) and len(np.unique(seeds)) == 64 and (seeds >= 0).all() and (seeds < 2**24).all()
    assert strata(drawn.mass_scale, 0.9, 1.1)
    assert strata(drawn.contact.stiffness / CASE.contact.stiffness, 0.5, 2.0, logs=True)
    np.testing.assert_array_equal(drawn.gravity, own.gravity)


def test_numbers_by_path_are_drawn_last_and_leave_the_other_draws():
    how = Ensemble(members=32, pushes=None)
    draws = {"contact.damping": Drawn(range=(10.0, 30.0)), "gravity": Drawn(factor=(0.5, 2.0), log=True),
             "mass_scale": Drawn(factor=(2.0, 3.0)),
             "hardware.force_sensor.noise": Drawn(range=(0.1, 1.0), log=True)}  # fmt: skip
    plain, found = ensemble.draw(CASE, how), ensemble.draw(CASE, how.model_copy(update={"draw": draws}))
    own = mc.parameters(CASE)
    assert strata(found.contact.damping, 10, 30) and strata(
        found.at("hardware.force_sensor.noise"), 0.1, 1.0, logs=True
    )
    # a factor is on the scenario's own, and takes the place of what was drawn
    assert (
        strata(found.gravity[..., 2] / float(own.gravity[2]), 0.5, 2.0, logs=True) and np.ptp(plain.gravity[..., 2]) > 0
    )
    assert strata(found.mass_scale, 2, 3)
    assert len(np.unique(found.at("hardware.seed"))) == 32
    for path in ("contact.stiffness", "disturbance.cargo.mass", "disturbance.cargo.start"):
        np.testing.assert_array_equal(found.at(path), plain.at(path))
    given = ensemble.draw(CASE, how.model_copy(update={"draw": draws | {"hardware.seed": Drawn(range=(3.0, 3.0))}}))
    np.testing.assert_array_equal(given.at("hardware.seed"), np.full((32, 1), 3.0))
    for wrong, said in [
        (
            {"gravity": Drawn(range=(1.0, 2.0))},
            "draw.gravity: expected a factor, as the value is an array, got a range",
        ),
        (
            {"hardware.force_sensor.bias": Drawn(factor=(1.0, 2.0))},
            "draw.hardware.force_sensor.bias: expected a value other than 0",
        ),
        ({"contact.none": Drawn(range=(1.0, 2.0))}, "draw.contact.none: expected a value at contact.none to change"),
    ]:
        with pytest.raises(mc.ConfigError) as refused:
            ensemble.draw(CASE, how.model_copy(update={"draw": wrong}))
        assert str(refused.value).startswith(said)


def test_draws_of_other_uses_and_of_other_searches_have_seeds_of_their_own():
    how = Ensemble(seed=7)
    assert [ensemble.fresh(how, use).seed for use in ensemble.Use] == [7 + n * 1_000_003 for n in (1, 2, 3)]
    assert ensemble.fresh(how).seed == 1_000_010 and [ensemble.of_search(how, n).seed for n in range(3)] == [7, 8, 9]


def test_cargo_of_members_is_drawn_from_its_ranges_and_factors_from_the_scenarios_own():
    """Not from what another section has drawn already."""
    how = Ensemble(members=16, pushes=None, cargo=ensemble.Cargo(mass=(2.0, 3.0), start=(0.5, 0.9)))
    found = ensemble.draw(CASE, how)
    assert strata(found.at("disturbance.cargo.mass"), 2, 3) and strata(found.at("disturbance.cargo.start"), 0.5, 0.9)
    bias = "hardware.force_sensor.bias"
    again = how.model_copy(update={"hardware": Hardware(force_bias=(1.0, 2.0)), "draw": {bias: Drawn(factor=(2, 3))}})
    with pytest.raises(mc.ConfigError, match="a value other than 0 in the scenario to scale, got 0"):
        ensemble.draw(CASE, again)


@pytest.mark.parametrize("seed", range(6))
def test_the_ends_of_the_ranges_are_refused_wherever_members_fall(seed):
    """So that another draw of the same ranges is not refused halfway."""
    fine, wide = (Ensemble(members=1, seed=seed, grip_stiffness=(1.0, most)) for most in (1.5, 1e4))
    ensemble.draw(CASE, fine)
    with pytest.raises(mc.ConfigError, match=r"^ensemble: "):
        ensemble.draw(CASE, wide)


def draw_with(**section):
    return ensemble.draw(CASE, Ensemble(hardware=Hardware(**section)))


IMPOSSIBLE = {
    "hardware: force_delay: expected low <= high, got 0.2, 0.1": lambda: Hardware.make({"force_delay": [0.2, 0.1]}),
    "drawn: expected a range or a factor, got none": lambda: Drawn.make({}),
    "drawn: expected a range or a factor, got both": lambda: Drawn.make({"range": [1, 2], "factor": [1, 2]}),
    "drawn: range: expected numbers above 0 with log, got 0": lambda: Drawn.make({"range": [0, 2], "log": True}),
    "hardware.friction: expected friction in the scenario to scale, got none": lambda: draw_with(friction=(1.0, 2.0)),
    "hardware.control_rate: expected at most the": lambda: draw_with(control_rate=(1.0, 1.001 / CASE.time_step)),
    "hardware.force_delay: expected at most 500": lambda: draw_with(force_delay=(0.0, 501 * CASE.time_step)),
}


@pytest.mark.parametrize("said", IMPOSSIBLE)
def test_ranges_of_no_draw_are_refused(said):
    with pytest.raises(mc.ConfigError) as refused:
        IMPOSSIBLE[said]()
    assert str(refused.value).startswith(said)
    assert Hardware(force_delay=(0.1, 0.1)).force_delay == (0.1, 0.1)
    assert Drawn(range=(0.1, 2.0), log=True).span == (0.1, 2.0) and Drawn(factor=(0.5, 2.0)).span == (0.5, 2.0)


def test_the_worst_members_are_those_of_a_sorted_list():
    rng = np.random.default_rng(2)
    for members, share in itertools.product((1, 2, 5, 16), (0.01, 0.2, 0.5, 0.6, 1.0)):
        values = rng.normal(size=(members, 3))
        count = max(1, math.ceil(round(share * members, 6)))
        for larger in (False, True):
            for column in range(3):
                ends = sorted(values[:, column].tolist(), reverse=not larger)[:count]
                found = ensemble.worst_mean(values, share, larger_is_better=larger)
                assert found[column] == pytest.approx(sum(ends) / count)


@pytest.mark.parametrize(
    ("pins", "fits"), [({"gait.duty": 0.8}, True), ({"gait.duty": 0.3}, False), ({"damping": 0.3}, True)]
)
def test_a_gait_that_is_pinned_must_be_one_that_the_scenario_can_have(pins, fits):
    search = Search(pins={"stiffness": 5.0} | pins)
    with contextlib.nullcontext() if fits else pytest.raises(mc.ConfigError, match="duty"):
        spaces.check_gait(CASE, search)
    with contextlib.nullcontext() if "damping" in pins else pytest.raises(mc.ConfigError, match="gains of the law"):
        spaces.refuse_gait(search)
    with pytest.raises(mc.ConfigError, match=r"gains of the law, as tune alone searches a gait, got gait\.cycle"):
        spaces.refuse_gait(Search(also=("gait.cycle",)))
