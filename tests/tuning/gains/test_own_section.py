"""Laws and metrics of the user's at the shell: what `--set` does to them, and what config.yaml says of them."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.control import PD, SHIPPED, law_of
from mjx_climb.inputs.file_contents import digest
from mjx_climb.scenario.messages import ConfigError
from tuning.command_line import options
from tuning.command_line.program import InputError
from tuning.gains import own_section
from tuning.gains.own_section import taken
from tuning.problem import objectives
from tuning.problem.search import Search
from tuning.results.config_file import write_config
from tuning.searches import tune

TEXT = """
import helper

import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance
from mjx_climb.control.virtual_mass import Motion
from mjx_climb.walk.metrics import total


class Scaled(VirtualModelAdmittance):
    share: object = mc.gain("1", length=1, bounds=(0.05, 1.0), default=helper.SHARE)


calm = Scaled(motion=Motion(deadband=(1.0, 0.1)))
way = total("way", "m", "way", lambda sample, _: sample.base_linear_velocity[0])
taken = total("travel", "m", "another travel", lambda sample, _: sample.base_linear_velocity[0])


def judge(metrics):
    return metrics["travel"]
"""


@pytest.fixture
def file(tmp_path):
    (tmp_path / "helper.py").write_text("SHARE = 0.5\n")
    path = tmp_path / "mine.py"
    path.write_text(TEXT)
    return path


def asked(config, *changes, law=None, controller=None, metrics=None):
    walk = options.Walk(
        config=Path(config), controller=controller, changes=tuple(changes), law=law, metrics=tuple(metrics or ())
    )
    found = walk.load()
    return found.scenario, found.law, found.metrics


@pytest.mark.parametrize("given", ["case_1_2", "config"])
def test_set_reaches_a_law_of_ones_own(file, tmp_path, given):
    law = f"{file}:Scaled"
    if given == "config":
        scenario, own, _ = asked("case_1_2", law=law)
        write_config(scenario, tmp_path / "out", own)
        given, law = tmp_path / "out" / "config.yaml", None
    changes = ["control.stiffness=3000", "control={share: 0.25, kp: 40}", "gravity=[0, 0, -1]"]
    scenario, own, _ = asked(given, *changes, law=law)
    np.testing.assert_array_equal(own.stiffness, [3000.0] * 6)
    assert own.share == 0.25 and own.damping == pytest.approx(5e3)
    assert (scenario.control.kp, scenario.control.stiffness, scenario.gravity[2]) == (40.0, 5e4, -1.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("control.deadband=1", "expected one of inertia, damping, stiffness, share, kp, kd, ki, safe_kp in control"),
        ("control.stiffness.2=1", "expected one of inertia"),
        ("control.controller=pd", "expected one of inertia"),
        ("control.stiffness=-1", "expected finite numbers above 0, got -1"),
        ("control.share=[1, 2]", "expected the gains of one law, got 2 of share"),
        ("control.share=much", "gains.share: expected real numbers"),
    ],
)
def test_what_a_law_of_ones_own_cannot_take_is_refused(file, change, said):
    with pytest.raises(InputError, match=f"^--set {re.escape(change.partition('=')[0])}: .*{re.escape(said)}") as error:
        asked("case_1_2", change, law=f"{file}:Scaled")
    assert "\n" not in str(error.value)


def test_a_controller_beside_a_law_is_refused_and_takes_the_place_of_a_configs(file, tmp_path):
    with pytest.raises(InputError, match=r"--controller: expected none with --law"):
        asked("case_1_2", law=f"{file}:Scaled", controller="pd")
    scenario, law, _ = asked("case_1_2", law=f"{file}:Scaled")
    write_config(scenario, tmp_path, law)
    scenario, law, _ = asked(tmp_path / "config.yaml", controller="pd")
    assert law is None and isinstance(law_of(scenario), PD)


@pytest.fixture
def written(file, tmp_path):
    """A folder of results that was moved, and the law and metrics that walked there."""
    scenario, law, metrics = asked("case_1_2", "control.damping=7", law=f"{file}:calm", metrics=[f"{file}:way"])
    back = write_config(scenario, tmp_path / "out", law, metrics)
    assert back.own is None
    (tmp_path / "out").rename(tmp_path / "moved")
    file.unlink()
    return tmp_path / "moved", law, metrics


def test_config_yaml_names_law_and_metrics(written):
    folder, law, metrics = written
    text = (folder / "config.yaml").read_text()
    assert str(folder.parent) not in text
    told = yaml.safe_load(text)["own"]
    assert (told["law"]["file"], told["law"]["name"]) == ("inputs/law/mine.py", "calm")
    scenario, again, table = asked(folder / "config.yaml")
    assert type(again).__name__ == "Scaled" and again.motion == law.motion
    for name in law.GAINS:
        np.testing.assert_array_equal(getattr(again, name), np.broadcast_to(getattr(law, name), (6,) * law.AXES[name]))
    assert table.names == metrics.names == (*mc.METRICS.names, "way") and scenario.own is None


def test_in_python_the_law_of_a_config_is_not_forgotten(written):
    folder, law, _ = written
    scenario = mc.load_scenario(folder / "config.yaml")
    with pytest.raises(ConfigError, match=r"own\.law: expected the law beside the scenario") as error:
        mc.rollout(scenario)
    assert "\n" not in str(error.value)
    assert taken(scenario)[1].motion == law.motion
    assert scenario.to_yaml() == mc.Scenario.from_yaml(scenario.to_yaml()).to_yaml()


@pytest.mark.parametrize("name", ["mine.py", "helper.py"])
def test_a_law_that_is_gone_or_changed_is_refused(written, name, call):
    folder, *_ = written
    for change, said in (
        (lambda file: file.write_text(file.read_text() + "# new\n"), "own.law.digest: expected "),
        (lambda file: file.unlink(), ""),
    ):
        change(folder / "inputs" / "law" / name)
        code, _, err = call("run", folder / "config.yaml", "--out", folder / "again")
        [line] = err.splitlines()
        assert code == 2 and said in line and "inputs/law/mine.py" in line


def test_a_law_of_a_session_is_named_and_refused(tmp_path):
    space = {}
    exec("from mjx_climb.control import VirtualModelAdmittance\nclass Mine(VirtualModelAdmittance): pass", space)
    write_config(mc.Scenario(), tmp_path, space["Mine"]())
    with pytest.raises(ConfigError, match=r"own\.law\.file: expected a file of Python, got none, as Mine was"):
        asked(tmp_path / "config.yaml")
    write_config(mc.Scenario(), tmp_path, PD())
    assert isinstance(asked(tmp_path / "config.yaml")[1], PD)


def test_a_file_of_a_folder_below_is_found_by_its_relative_path(file, monkeypatch):
    monkeypatch.chdir(file.parent.parent)
    named = f"{file.parent.name}/mine.py"
    assert own_section.load(f"{named}:judge", "objective")[0]({"travel": 1.0}) == 1.0
    assert digest(Path(named)) == digest(file)


def test_an_objective_is_named_and_found_again_by_a_plain_search_alone(file, tmp_path):
    judge, *_ = own_section.load(f"{file}:judge", "objective")
    write_config(mc.Scenario(), tmp_path, objective=judge)
    scenario, law, _ = asked(tmp_path / "config.yaml")
    assert law is None and scenario.own.objective.name == "judge"
    bare, again = tune.own_objective(scenario)
    assert again.__code__ == judge.__code__ and bare.own is None
    with pytest.raises(ConfigError, match=r"own\.objective: expected none but in a plain search, got judge"):
        tune.problem_of(scenario, Search())


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ("missing", "expected a function named missing, got none"),
        ("calm", "expected calm to be a function of the metrics, got Scaled("),
    ],
)
def test_what_is_no_objective_is_refused_in_one_line(file, named, said):
    with pytest.raises(ConfigError, match=re.escape(f"{file}: {said}")):
        tune.own_objective(mc.Scenario(), f"{file}:{named}")


@pytest.mark.parametrize(
    ("objective", "said"),
    [
        (lambda metrics: metrics["nothing"], "objective: KeyError: 'nothing'"),
        (lambda metrics: metrics["travel"] * np.nan, "objective: expected a number of pd's walk, got nan"),
        (lambda metrics: 1.0, "objective: expected an array made of metrics, shape () as theirs, got 1.0"),
        (lambda metrics: None, "objective: expected an array made of metrics, shape () as theirs, got None"),
        (
            lambda metrics: jnp.stack([metrics["travel"], metrics["travel"]]),
            "objective: expected an array made of metrics, shape () as theirs, got shape (2,)",
        ),
    ],
)
def test_an_objective_that_fails_is_refused_in_one_line(objective, said):
    baseline = {"base_deviation": 0.01, "travel": 1.0}
    with pytest.raises(ConfigError, match=f"^{re.escape(said)}$"):
        objectives.objective(Search(), baseline, objective)


def test_an_objective_has_its_own_value_of_pd_and_reads_smooth_metrics_of_a_walk_that_has_none():
    baseline = {"base_deviation": 0.01, "travel": 2.0, "smooth_travel": 1.9, "cost_of_transport": 10.0}

    def mine(metrics):
        return 3 * metrics["smooth_travel"] + metrics["smooth_cost_of_transport"]

    goal = objectives.objective(Search(), baseline, mine)
    assert goal.reference == pytest.approx(15.7)
    alone = {"joint_limit_margin": 1.0, "peak_utilization": 0.0, "diverged": np.array(False)}
    alone |= {name: value for name, value in baseline.items() if name != "smooth_travel"}
    assert float(goal.score(alone).value) == pytest.approx(16.0)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("missing", "expected a metric named missing, got none"),
        ("total", "expected total to be a metric, as of mjx_climb.Metric, got <function total"),
        ("taken", "taken: metric travel: expected one of this name, got two"),
    ],
)
def test_what_is_no_metric_is_refused_in_one_line(file, name, said):
    with pytest.raises(ConfigError, match=re.escape(f"{file}: {said}")) as refused:
        own_section.load_metrics([f"{file}:{name}"])
    assert "\n" not in str(refused.value)


def test_metrics_of_ones_own_come_behind_the_shipped_and_each_other(file):
    file.write_text(TEXT + "back = total('back', 'm', 'way back', lambda sample, _: -sample.base_linear_velocity[0])\n")
    table = own_section.load_metrics([f"{file}:back", f"{file}:way"])
    assert table.names == (*mc.METRICS.names, "back", "way")
    write_config(mc.Scenario(), file.parent / "out", metrics=table)
    folder = file.parent / "out"
    assert asked(folder / "config.yaml")[2].names == table.names
    named = mc.load_scenario(folder / "config.yaml").own.metrics
    assert [each.name for each in named] == ["back", "way"]
    for copy in folder.rglob("mine.py"):
        copy.unlink()
    with pytest.raises(ConfigError, match=r"inputs/metrics\.0/mine\.py: expected a readable file, got no such"):
        asked(folder / "config.yaml")
    with pytest.raises(ConfigError, match=r"own\.metrics\.0\.file: expected a file of Python, got none, as gone was"):
        taken(mc.Scenario().with_overrides({"own": {"metrics": [{"name": "gone"}]}}))


def test_numbers_of_a_law_that_are_no_gains_are_its_limits_and_truth_values_are_none():
    class Own(PD):
        """With one of each."""

        most: float = 0.5
        count: int = 3
        strict: bool = True
        name: str = "a"

    law = Own()
    assert own_section.limits_of(law) == {"most": 0.5, "count": 3.0}
    for most in (0.4, 0.6):
        assert own_section.limits_of(own_section.with_limits(law, {"most": most})) == {"most": most, "count": 3.0}
    assert own_section.with_limits(law, {"most": 0.5}) is law


def test_a_law_by_a_name_that_is_none_is_refused_with_those_that_there_are():
    with pytest.raises(ConfigError) as refused:
        own_section.load_law("Load")
    assert str(refused.value) == f"law: expected FILE.py:NAME, or one of {', '.join(SHIPPED)}, got 'Load'"


def test_what_was_stored_for_another_law_says_both():
    law, own = Holder.Inner(), f"{Path(__file__).name}:Holder.Inner"
    own_section.check_reference(law, own, "file")
    own_section.check_reference(None, None, "file")
    for given, stored, said in [
        (law, "PD", f"expected gains of {own}, got those of PD"),
        (law, None, f"expected gains of {own}, got those of the config's law"),
        (None, "Mine", "expected gains of the config's law, got those of Mine"),
        (None, "pd", "expected no such key in gains of the config's own controller, got pd"),
        (law, "pd", f"expected gains of {own}, got those of pd"),
    ]:
        with pytest.raises(ConfigError) as refused:
            own_section.check_reference(given, stored, "file")
        assert str(refused.value) == f"file: law: {said}"


class Holder:
    """Has a law within."""

    class Inner(mc.control.PD):
        """Another pd."""

        def step(self, state, measured, reference):
            return super().step(state, measured, reference)


def test_a_class_within_another_is_named_with_it():
    assert own_section.reference(Holder.Inner()) == f"{Path(__file__).name}:Holder.Inner"
    assert own_section.reference(mc.control.PD()) == "PD"
