"""Gains on worse hardware: the same members in every setting but for what it changes."""

import json

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tests.shell import ROOT
from tuning.comparisons import degraded
from tuning.gains import gains_file
from tuning.pages import degraded as pages
from tuning.problem.ensemble import Ensemble
from tuning.problem.evaluation import Problem

CASE = mc.load_scenario(
    ROOT / "configs" / "case_1_2.yaml",
    ["duration=0.3", "hardware.force_sensor.noise=0.1", "hardware.command_delay=0.002"],
)
DRAW = Ensemble.parse("{hardware: {force_delay: [0.001, 0.004]}}", "ensemble")
GAINS = {"mine": mc.Gains(1.0, 300.0, 3000.0)}


def drawn(*worse, members=4):
    return degraded.draw_of(Problem(CASE), GAINS, DRAW, worse, members)


def test_members_differ_between_settings_in_what_is_made_worse_alone():
    work = drawn("delay=x2", "force_sensor.noise=0.5", "force_sensor.dead.LF=3.0,noise=x3")
    assert work.settings[0] == degraded.AS_DRAWN and work.rows == 16 and work.identity()["settings"] == [*work.settings]
    parameters, own = work.problem.parameters, drawn().problem.parameters
    late = np.asarray(parameters.force_sensor.delay).reshape(4, 4)
    np.testing.assert_allclose(late, np.asarray(own.force_sensor.delay).reshape(1, 4) * np.array([[1], [2], [1], [1]]))
    assert np.reshape(parameters.bus.command_delay, (4, 4)).tolist() == [
        [0.002] * 4,
        [0.004] * 4,
        [0.002] * 4,
        [0.002] * 4,
    ]
    noise = np.reshape(parameters.force_sensor.noise, (4, 4))
    np.testing.assert_allclose(noise, np.array([[0.1], [0.1], [0.5], [0.3]]) * np.ones(4))
    dead = np.reshape(np.broadcast_to(parameters.force_sensor.dead, (16, 1, 4)), (4, 4, 4))
    assert np.isinf(dead[:3]).all() and (dead[3, :, 0] == 3).all() and np.isinf(dead[3, :, 1:]).all()
    np.testing.assert_array_equal(np.reshape(parameters.mass_scale, (4, 4)), np.tile(np.ravel(own.mass_scale), (4, 1)))


@pytest.mark.parametrize(("factor", "period"), [("x1.2", 0.002), ("x1.3", 0.003), ("x0.1", 0.001), ("x2", 0.004)])
def test_a_period_is_scaled_to_whole_time_steps_one_at_least(factor, period):
    scenario = CASE.with_overrides({"hardware.control_period": 0.002})
    changed = degraded.worsened(scenario, mc.parameters(scenario), degraded.setting(f"period={factor}"))
    assert float(changed.bus.control_period) == pytest.approx(period, rel=1e-6)


@pytest.mark.parametrize(
    ("worse", "said"),
    [
        ("friction=x2", "expected friction in the config or the draw to scale, got none"),
        ("delay=2", "delay: expected a factor above 0, as x2, got '2'"),
        ("delay=x-1", "delay: expected a factor above 0"),
        (
            "delay",
            "expected delay|period|friction|backlash|noise|bias|armature|PATH=xFACTOR, PATH=VALUE or a key of hardware",
        ),
        ("nothing=3", "nothing"),
        ("contact.damping=x10", "time_step: expected one short enough for"),
        ("delay=x2,delay=x2", ""),
    ],
)
def test_what_cannot_be_made_worse_is_refused_in_one_line(worse, said, call, tmp_path):
    gains_file.save(GAINS["mine"], tmp_path / "mine.yaml")
    twice = ("--worse", worse) if not said else ()
    words = ("evaluate", "case_1_2", "--gains", tmp_path / "mine.yaml", "--worse", worse, *twice)
    code, out, err = call(*words, "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith("mjx-climb: error: --worse: ") and said in err


def test_settings_are_read_as_factors_and_values():
    """Keys without a section of the scenario's are those of its hardware, but for masses."""
    text = "delay=x2, force_sensor.dead.LF = 3.0,contact.spread=0.5,mass_scale=1.2,hardware.seed=4,contact.damping=x0.5"
    found = degraded.setting(text)
    assert found == (text, {"delay": 2.0, "contact.damping": 0.5}, {
        "hardware.force_sensor.dead.LF": 3.0, "contact.spread": 0.5, "mass_scale": 1.2, "hardware.seed": 4,
    })  # fmt: skip


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("interpolation=linear", "worse: expected a number of the hardware, got hardware.interpolation"),
        ("contact.kind=polyhedron", "worse: contact.kind: expected a number, got 'polyhedron'"),
        ("contact.stiffness=true", "worse: contact.stiffness: expected a number, got True"),
        ("backlash=x2", "worse: expected backlash in the config or the draw to scale, got none (drive: Servos)"),
        ("contact.spread=1", "worse: contact.spread: expected a value at contact.spread to change, got Gripper"),
    ],
)
def test_settings_that_change_nothing_are_refused(text, said):
    with pytest.raises(mc.ConfigError) as error:
        degraded.worsened(CASE, mc.parameters(CASE), degraded.setting(text))
    assert str(error.value).startswith(said)


def test_values_of_keys_of_the_hardware_take_the_place_of_those_drawn():
    """A path by its value, a section by all that it holds; the rest stays as it was drawn."""
    own = mc.parameters(CASE)
    found = degraded.worsened(CASE, own, degraded.setting("force_sensor.dead.LF=3.0,command_delay=0.004"))
    assert np.ravel(found.force_sensor.dead).tolist() == [3.0, np.inf, np.inf, np.inf]
    assert float(found.bus.command_delay) == 0.004 and float(own.bus.command_delay) != 0.004
    changed = {path for path, value in found.values.items() if not np.array_equal(value, own.values[path])}
    assert changed == {"hardware.force_sensor.dead", "hardware.command_delay"}


def test_tables_say_what_worse_hardware_takes_and_what_is_left_of_the_lead():
    """Of made-up walks: a dead sensor makes the first gains half as bad again, and loses a walk in four."""
    rng, members = np.random.default_rng(0), 64
    level = {"mine": (8.0, 12.0), "pd": (10.0, 10.0)}
    base = 1 + 0.01 * rng.normal(size=members)
    values = np.array([[base * level[name][place] for name in level] for place in (0, 1)])
    about = {"units": "N", "long_name": "force variation", "larger_is_better": 0}
    dims = ("setting", "gains", "member")
    pull = np.zeros_like(values)
    pull[1, 0, ::4] = 9.0
    data = {name: (dims, values, about) for name in degraded.METRICS} | {"diverged": (dims, np.zeros_like(values))}
    data |= {"peak_pull_force": (dims, pull, about), "peak_utilization": (dims, pull / 4.0)}
    names = {"setting": [degraded.AS_DRAWN, "dead"], "gains": [*level], "member": range(members)}
    walks = xr.Dataset(data, names)
    found = degraded.Degraded(walks, Problem(CASE), ensemble=DRAW)
    compared = degraded.summary(walks)
    assert compared.baseline == "pd"
    losses, lead = pages.losses_table(found, compared), pages.lead_table(found, compared)
    assert losses.sections[0][1] == [["force variation", "mine", losses.sections[0][1][0][2], "+50"],
                                     ["force variation", "pd", losses.sections[0][1][1][2], "0"]]  # fmt: skip
    assert losses.sections[-1][1] == [["lost of 64", "mine", "0", "16"], ["lost of 64", "pd", "0", "0"]]
    assert lead.sections[0][1] == [["force variation", "mine", "-20", "+20"]]
    said = pages.in_words(found, compared)
    told = json.loads(pages.contents(found, compared, "").written.summary)
    assert told["verdict"] == said and told["gains"]["mine"]["mean"]["dead"]["failed"] == 0.25
    rows = {(each["setting"], each["metric"], each["statistic"]): each for each in told["differences"]}
    own = rows["dead", "force_variation", "mean"]
    assert own["claimed"] and own["gains"] == "mine" and 0 < own["low"] < own["difference"] < own["high"]
    ours, theirs = (float(each) for each in np.mean(base) * np.array([8.0, 10.0]))
    assert said == (
        f"mine: mean force variation as drawn {ours:.4g} N, 20.0 % less than the best rival that walked, pd as the "
        f"config has it: {theirs:.4g} N; mine is ahead: as drawn; mine is behind: dead; the force variation of mine "
        f"rises most with dead, from {ours:.4g} to {1.5 * ours:.4g} N; mine loses most walks: dead, 16 of 64"
    )
    swapped = degraded.Degraded(walks.isel(gains=[1, 0]), Problem(CASE), ensemble=DRAW)
    said = pages.in_words(swapped, degraded.summary(swapped.data))
    assert said == (
        f"pd: mean force variation as drawn {theirs:.4g} N, 25.0 % more than the best rival that walked, mine: "
        f"{ours:.4g} N; pd is ahead: dead; pd is behind: as drawn; no rise of the force variation of pd can be told; "
        "pd loses no walk in any setting, of 64 in each"
    )
    assert pages.plot_degraded(walks).axes[0].get_xlabel() == "mean force variation [N]"


def test_the_lead_is_that_over_the_best_rival_that_walked():
    """In every setting, by the same walks; as drawn the best of those that lose no more walks, whatever its law."""
    rng, level = np.random.default_rng(0), {"mine": 8.0, "pd": 10.0, "config": 8.5, "retuned_pd": 9.0}
    base = 1 + 0.01 * rng.normal(size=32)
    values = np.array([[base * each for each in level.values()]] * 2)
    dims, about = ("setting", "gains", "member"), {"units": "N", "long_name": "", "larger_is_better": 0}
    data = {name: (dims, values, about) for name in degraded.METRICS}
    data |= {name: (dims, 0 * values, about) for name in ("diverged", "peak_utilization")}
    data["peak_utilization"][1][0, 2, 0] = 2.0  # one grip of the config's
    walks = xr.Dataset(data, {"setting": [degraded.AS_DRAWN, "late"], "gains": [*level], "member": range(32)})
    each = (
        ([*level], "retuned_pd", 8 / 9 - 1),
        (["mine", "pd"], "pd", -0.2),
        (["mine", "config"], "config", 8 / 8.5 - 1),
    )
    for names, rival, less in each:
        found = degraded.summary(walks.sel(gains=names))
        assert found.baseline == rival
        for lead in found.lead.values():
            assert rival not in lead["gains"] or float(lead["difference"].sel(gains=rival).max()) == 0
            mean = lead.sel(metric="force_variation", statistic="mean")
            share = mean["difference"].sel(gains="mine") / mean["value"].sel(gains=rival)
            assert float(share) == pytest.approx(less, rel=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
def test_the_command_walks_as_drawn_as_evaluate_does(call, tmp_path):
    gains_file.save(GAINS["mine"], tmp_path / "mine.yaml")
    words = ("case_1_2", "--set", "duration=0.3", "--gains", tmp_path / "mine.yaml", "--members", "3")
    assert call("evaluate", *words, "--out", tmp_path / "plain")[0] == 0
    worse = ("--worse", "force_sensor.bias=1.0", "--out", tmp_path / "worse")
    code, out, err = call("evaluate", *words, *worse)
    assert "3 test walks give no interval of any mean (from 64 on)" in err
    assert code == 0 and "; cannot be told apart: as drawn, force_sensor.bias=1.0; no rise of the force" in out
    plain = xr.load_dataset(tmp_path / "plain" / "judged.nc", engine="h5netcdf")
    both = xr.load_dataset(tmp_path / "worse" / "degraded.nc", engine="h5netcdf")
    own, late = (both["force_variation"].sel(setting=name) for name in both["setting"].values)
    np.testing.assert_allclose(own, plain["force_variation"], rtol=1e-3)
    assert (late.sel(gains="mine") != own.sel(gains="mine")).all()
    written = {file.name for file in (tmp_path / "worse").iterdir()}
    assert {"report.html", "degraded.png", "summary.json", "ensemble.yaml"} <= written
