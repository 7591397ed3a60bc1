"""A control law from a user's script, of `docs/guides/law.md`: walked, batched, differentiated, swept and tuned."""

import dataclasses
import importlib.util
import re
import statistics
import sys
import time
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import SHIPPED, VirtualModelAdmittance, law_of
from mjx_climb.files.dataset import OutputError
from mjx_climb.walk.metrics import total
from tuning.command_line import options
from tuning.gains import gains_file, own_section
from tuning.searches.sweep import sweep
from tuning.searches.tune import tune

SCRIPT = Path(__file__).parents[2] / "docs" / "guides" / "filtered_law.py"
SHORT = (("duration", 0.1), ("gait.cycle", 0.5), ("disturbance.cargo.start", 0.02), ("disturbance.cargo.mass", 0.5))


def from_script():
    """Return a new class of the script."""
    spec = importlib.util.spec_from_file_location("filtered_law", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Filtered


Filtered = from_script()


@pytest.fixture(scope="module")
def scenario(case):
    return case("case_1_2", "virtual_model", (*SHORT, ("control.damping", 1e2), ("control.stiffness", 3e3)))


@pytest.fixture(scope="module")
def law():
    return Filtered(damping=1e2, stiffness=3e3)


def test_the_script_is_short_and_the_page_leads_to_it():
    assert len(SCRIPT.read_text().splitlines()) <= 40
    assert f"({SCRIPT.name})" in (SCRIPT.parent / "law.md").read_text()


def test_the_small_law_of_the_page_yields_to_what_pushes_the_base(tmp_path):
    """Written as the page says: the ground pushes the feet with +x, so something pushes the base along -x."""
    (block,) = re.findall(r"```python\n(.*?class Yielding.*?)```", (SCRIPT.parent / "law.md").read_text(), re.DOTALL)
    (tmp_path / "page.py").write_text(block)
    law = own_section.load_law(f"{tmp_path / 'page.py'}:Yielding")
    zero, feet, up = jnp.zeros(3), jnp.zeros((4, 3)), jnp.array([1.0, 0.0, 0.0, 0.0])
    reference = mc.Reference(zero, up, feet)
    wrench = jnp.array([10.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    measured = mc.Measurement(zero, up, zero, zero, feet, wrench, jnp.ones(4, bool))
    state, command = law.init(mc.control.Start(1e-3, reference)), None
    for _ in range(3):
        state, command = law.step(state, measured, reference)
    assert command.base_position[0] < 0 and command.base_displacement[5] < 0
    np.testing.assert_allclose(command.base_displacement[0], -3 * 1e-3 * 10 / 5e3, rtol=0.02)


def test_a_dataclass_that_does_not_inherit_from_law_is_refused_in_one_line(tmp_path):
    text = "import dataclasses\n@dataclasses.dataclass(frozen=True)\nclass Mine:\n    damping: float = 1.0\n"
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(mc.ConfigError, match=r"expected Mine to be a law that inherits from mjx_climb\.Law") as refused:
        own_section.load_law(f"{tmp_path / 'mine.py'}:Mine")
    assert "\n" not in str(refused.value)


@pytest.mark.nightly
def test_an_open_filter_is_eq_3_and_a_closed_one_is_not(scenario, law):
    """The filter passes everything at 1e6 Hz; at 1e-6 Hz next to nothing, which is the walk of pd."""
    cutoff = np.array([1e6, 1e-6])[:, None] * np.ones(6)
    ours = mc.rollout_metrics(scenario, {"cutoff": cutoff}, law=law, dtype=np.float64)
    shipped = mc.rollout_metrics(scenario, dtype=np.float64)
    pd = mc.rollout_metrics(scenario.with_overrides({"control.controller": "pd"}), dtype=np.float64)
    for name in ("peak_foot_force", "force_variation", "travel", "base_deviation"):
        np.testing.assert_allclose(ours[name], [shipped[name], pd[name]], rtol=1e-6, err_msg=name)
    assert abs(ours["force_variation"][0] / ours["force_variation"][1] - 1) > 1e-3
    walk = mc.rollout(scenario, {"cutoff": cutoff[0]}, law=law)
    assert mc.metrics(walk)["force_variation"] == pytest.approx(float(ours["force_variation"][0]), rel=1e-9)
    six = dict.fromkeys(("inertia", "damping", "stiffness", "cutoff"), (6,))
    assert (walk.law, {name: value.shape for name, value in walk.gains.items()}) == ("Filtered", six | {"share": ()})


@pytest.mark.nightly
def test_tangents_along_own_gains_agree_with_central_differences(scenario, law):
    """Along the cut-off of one axis and the share, for two robots."""
    gains = {"cutoff": np.array([[20.0], [50.0]]) * np.ones(6), "share": np.array([0.9, 0.5])}
    along = {"cutoff": np.stack([np.eye(6)[2], np.zeros(6)])[:, None], "share": np.array([[0.0], [1.0]])}
    how = {"law": law, "dtype": np.float64, "smooth": True}
    _, tangents = mc.rollout_jvp(scenario, gains, along, **how)
    for row, step in ((0, 1e-3), (1, 1e-5)):
        sides = [{name: value + h * along[name][row] for name, value in gains.items()} for h in (step, -step)]
        there = [mc.rollout_metrics(scenario, side, **how) for side in sides]
        for name in ("force_variation", "cost_of_transport", "base_deviation", "travel"):
            difference = (there[0][name] - there[1][name]) / (2 * step)
            size = np.abs(difference).max()
            assert size > 0, name
            np.testing.assert_allclose(tangents[name][row], difference, rtol=1e-3, atol=1e-4 * size, err_msg=name)


@pytest.mark.slow
def test_swept_over_its_own_gain(scenario, law, tmp_path):
    axes = {"cutoff": np.array([1.0, 100.0]), "share": np.array([0.1, 0.5, 1.0])}
    result = sweep(scenario, axes, law=law, out=tmp_path, precision="float64").data
    assert result["force_variation"].dims == ("cutoff", "share")
    assert result["cutoff"].attrs["units"] == "Hz"
    alone = mc.rollout_metrics(scenario, {"cutoff": 100.0, "share": 0.5}, law=law, dtype=np.float64)
    np.testing.assert_allclose(result["force_variation"][1, 1], alone["force_variation"], rtol=1e-9)
    with pytest.raises(ValueError, match=r"^axes.nothing: expected a gain of the law, one of inertia, damping"):
        sweep(scenario, {"nothing": [1.0], "share": [1.0]}, law=law)


def stop(now):
    raise KeyboardInterrupt


@pytest.mark.nightly
def test_tuned_over_all_of_its_gains_saved_and_read_back(scenario, law, tmp_path):
    how = {"also": ("inertia",), "method": "cmaes", "starts": 4, "iterations": 2, "precision": "float64"}
    undisturbed = tune(scenario, law=law, **how)
    assert tune(scenario, law=law, out=tmp_path, progress=stop, **how).interrupted
    with pytest.raises(OutputError, match="another that differs in law"):
        tune(scenario, law=Filtered(damping=1e2, stiffness=3e3, share=0.9), out=tmp_path, **how)
    found = tune(scenario, law=law, out=tmp_path, **how)
    for name in ("theta", "value", "force_variation"):
        np.testing.assert_array_equal(found.data[name], undisturbed.data[name])
    assert list(found.data["coordinate"].values) == ["inertia", "damping", "stiffness", "cutoff", "share"]
    alone = mc.rollout_metrics(scenario, found.gains, law=law, smooth=True, dtype=np.float64)
    np.testing.assert_allclose(found.metrics["force_variation"], alone["force_variation"], rtol=1e-9)

    file = gains_file.save(found.gains, tmp_path / "gains.yaml", law=law)
    assert "law: filtered_law.py:Filtered" in file.read_text()
    for name, value in gains_file.load(file, law).items():
        np.testing.assert_array_equal(value, found.gains[name])
    with pytest.raises(mc.ConfigError, match=r"gains\.yaml: law: expected gains of the config's law, got those"):
        gains_file.load(file)
    with pytest.raises(mc.ConfigError, match=r"expected gains of Other, got those of filtered_law\.py:Fil"):
        gains_file.load(file, Other())


class Other(VirtualModelAdmittance):
    """The shipped law under another name."""


@pytest.mark.nightly
def test_another_class_of_the_same_name_walks_as_itself(scenario, law):
    """In one session the program of a law that was replaced is not taken for that of the new one."""
    again = from_script()
    assert again is not Filtered and again.__qualname__ == Filtered.__qualname__
    filtered = again.step
    again.step = lambda self, s, m, r: filtered(self, s, m._replace(wrench=2 * m.wrench), r)
    before, after = (mc.rollout_metrics(scenario, law=kind(damping=1e2, stiffness=3e3)) for kind in (Filtered, again))
    doubled = mc.rollout_metrics(scenario, {"share": 2.0}, law=law)
    assert before["force_variation"] != after["force_variation"]
    np.testing.assert_allclose(after["force_variation"], doubled["force_variation"], rtol=1e-4)


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        (
            {"cutof": 1.0},
            "gains.cutof: expected one of inertia, damping, stiffness, cutoff, share, kp, kd, ki, safe_kp, the",
        ),
        ({"cutoff": -1.0}, "gains.cutoff: expected finite numbers above 0, got -1"),
        ({"cutoff": np.ones((2, 5))}, "gains.cutoff: expected a scalar or a last axis of six, got shape (2, 5)"),
        ({"share": np.nan}, "gains.share: expected finite numbers above 0, got nan"),
        ({"kp": 0.0}, "gains.kp: expected finite numbers above 0, got 0"),
    ],
)
def test_gains_that_cannot_be_are_refused_in_one_line(scenario, law, gains, said):
    with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
        mc.rollout_metrics(scenario, gains, law=law)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing", "law: expected FILE.py:NAME, or one of ClimbSDK, "),
        ("nothing:", "law: expected FILE.py:NAME, got 'nothing:'"),
        ("nothing.py:Law", "nothing.py: expected a file of Python, got none"),
        (f"{SCRIPT}:Missing", "expected a law named Missing, got none"),
        (f"{SCRIPT}:jnp", "expected jnp to be a law that inherits from mjx_climb.Law"),
    ],
)
def test_a_law_that_is_none_is_refused_in_one_line(text, said):
    with pytest.raises(mc.ConfigError, match=re.escape(said)):
        own_section.load_law(text)


def test_a_law_is_known_by_its_file_and_name():
    assert own_section.reference(own_section.load_law(f"{SCRIPT}:Filtered")) == "filtered_law.py:Filtered"


def test_equal_arguments_give_the_same_simulator(scenario, law):
    assert mc.simulator(scenario) == mc.simulator(scenario.model_copy())
    assert mc.simulator(scenario, law=law) == mc.simulator(scenario, law=dataclasses.replace(law))
    assert mc.simulator(scenario, law=law) != mc.simulator(scenario, law=dataclasses.replace(law, share=0.5))
    assert mc.simulator(scenario, law=law) != mc.simulator(scenario, law=from_script()(damping=1e2, stiffness=3e3))
    assert mc.simulator(scenario) == mc.simulator(scenario, law=law_of(scenario))


@pytest.mark.timing
@pytest.mark.slow
def test_as_fast_as_the_shipped_law(scenario, law):
    """At 64 robots on a CPU, no less than 0.9 of its speed: medians of CPU times of walks that take turns."""
    long = scenario.with_overrides({"duration": 2.0})
    gains = {"stiffness": 3e3 * np.random.default_rng(0).uniform(1, 2, (64, 6))}
    seconds = {None: [], law: []}
    for number in range(7):
        for which, taken in seconds.items():
            begin = time.process_time()
            mc.rollout_metrics(long, gains, law=which)
            taken += [time.process_time() - begin] if number else []  # the first one compiles
    assert statistics.median(seconds[None]) / statistics.median(seconds[law]) > 0.9


SHARE = 1.0  # read by the law and the metric below


class ReadsAGlobal(VirtualModelAdmittance):
    def step(self, state, measured, reference):
        return super().step(state, measured._replace(wrench=SHARE * measured.wrench), reference)


WAY = (*mc.METRICS, total("way", "m", "way", lambda s, _: SHARE))


@pytest.mark.parametrize("own", [{"law": ReadsAGlobal(damping=1e2)}, {"metrics": WAY}], ids=["law", "metric"])
def test_another_value_of_a_global_is_another_program(scenario, monkeypatch, own):
    before = mc.simulator(scenario, **own)
    assert mc.simulator(scenario, **own) == before
    monkeypatch.setattr(sys.modules[__name__], "SHARE", 0.0)
    assert mc.simulator(scenario, **own) != before


# --- Shipped laws by the names of their classes


def test_a_shipped_law_goes_by_its_name(tmp_path):
    """As an option, in a gains file and in a config; a name that is none gives one line with all of them."""
    for name, kind in SHIPPED.items():
        assert type(own_section.load_law(name)) is kind and own_section.reference(kind()) == name
    law = dataclasses.replace(SHIPPED["LoadTransfer"](), leak=0.7)
    file = gains_file.save({name: getattr(law, name) for name in law.GAINS}, tmp_path / "gains.yaml", law=law)
    assert "law: LoadTransfer" in file.read_text() and gains_file.shipped_law(file) == "LoadTransfer"
    asked = options.Walk(config="case_1_2", gains=file).load_with_gains()
    assert (type(asked.law), float(asked.law.leak)) == (type(law), 0.7)
    own = {"own": {"law": {"name": "LoadTransfer", "gains": {"leak": 0.9}}}}
    _, taken, _ = own_section.taken(mc.load_scenario("case_1_2", own))
    assert (type(taken), float(taken.leak)) == (type(law), 0.9)
    with pytest.raises(mc.ConfigError, match=f"one of {', '.join(SHIPPED)}, got 'LoadTransfr'$"):
        own_section.load_law("LoadTransfr")
    with pytest.raises(mc.ConfigError, match="law: expected gains of the config's law, got those of LoadTransfer"):
        gains_file.load(file)
