"""Laws side by side: what each is searched by, what is refused, and a comparison from start to end."""

import contextlib
import html
import json
import signal

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
import tuning
from mjx_climb.control import PD, PlannedTransfer, VirtualModelAdmittance, shifted
from mjx_climb.scenario.load import load_hardware, with_hardware
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.shipped import config_path
from tests.shell import ends, finish, same_files, start, wait_for_parts
from tuning.background import silent
from tuning.comparisons import compare
from tuning.gains import gains_file
from tuning.problem.ensemble import Ensemble, draw
from tuning.problem.evaluation import Problem, under_pd
from tuning.problem.readings import reads_forces
from tuning.problem.search import Search
from tuning.searches import tune

CASE = config_path("case_1_2.yaml")
SHORT = ["duration=0.3", "disturbance.cargo.start=0.1"]
DRAWN = """
members: 2
pushes: null
cargo: null
gravity: null
hardware: {force_delay: [0.002, 0.015], control_rate: [100, 500], friction: [0.5, 2.0]}
"""
LAW = """
import mjx_climb as mc
from mjx_climb.control import VirtualModelAdmittance


class Shared(VirtualModelAdmittance):
    share: object = mc.gain("1", length=1, bounds=(0.05, 1.0), default=0.5, searched=False)

    def step(self, state, measured, reference):
        return super().step(state, measured._replace(wrench=self.share * measured.wrench), reference)
"""


@pytest.fixture(scope="module")
def scenario():
    scenario = mc.load_scenario(CASE, SHORT)
    return with_hardware(scenario, load_hardware("dynamixel_x"), "dynamixel_x")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    (folder / "law.py").write_text(LAW)
    (folder / "drawn.yaml").write_text(DRAWN)
    return folder


def settings(**changes):
    return compare.alike(Search.make({"method": "cmaes", **changes}), {"method"})


def test_each_law_is_searched_by_what_it_has_of_the_settings(scenario, files):
    wanted = settings(also=("share", "inertia"), bounds={"share": (0.1, 0.9), "kp": (10, 90)}, pins={"stiffness": 2e3})
    found = compare.contestants(scenario, ["base_admittance", f"{files}/law.py:Shared"], wanted)
    assert {name: set(own.space.names) for name, own in found.items()} == {
        "base_admittance": {"damping", "inertia", "kp", "kd"},
        "Shared": {"damping", "inertia", "share", "kp", "kd"},
        "PlannedTransfer": {"kp", "kd", *(name for name, gain in PlannedTransfer.GAINS.items() if gain.searched)},
        "retuned_pd": {"kp", "kd"},
    }
    assert {(own.search.starts, own.search.iterations) for own in found.values()} in ({compare.FEW}, {compare.MANY})
    for own in found.values():
        bounds = dict(zip(own.space.names, np.exp([own.space.lower, own.space.upper]).T, strict=True))
        np.testing.assert_allclose(bounds["kp"], (10, 90))
        if "share" in bounds:
            np.testing.assert_allclose(bounds["share"], (0.1, 0.9))


def test_laws_have_names_of_their_own_or_given_ones(scenario, files):
    law = VirtualModelAdmittance(1.0, 1e3, 1e4)
    given = {"soft": law, "stiff": "end_effector_admittance", "mine": f"{files}/law.py:Shared"}
    found = compare.contestants(scenario, given, settings())
    assert list(found) == ["soft", "stiff", "mine", "PlannedTransfer", "retuned_pd"]
    assert found["soft"].law is law and type(found["mine"].law).__name__ == "Shared"
    assert found["stiff"].scenario.control.controller == "end_effector_admittance"
    own = compare.contestants(scenario, [law, PD(), "LoadTransfer"], settings())
    assert list(own) == ["VirtualModelAdmittance", "LoadTransfer", "PlannedTransfer", "retuned_pd"]


def test_a_rival_without_a_sensor_walks_where_a_law_reads_one(scenario):
    for laws, names in (
        (["LoadTransfer"], ["LoadTransfer", "PlannedTransfer", "retuned_pd"]),
        (["PlannedTransfer", "LoadTransfer"], ["PlannedTransfer", "LoadTransfer", "retuned_pd"]),
        (["FootOffsets"], ["FootOffsets", "retuned_pd"]),
    ):
        assert list(compare.contestants(scenario, laws, settings())) == names
    grid = settings(method="grid", space="isotropic")
    assert list(compare.contestants(scenario, ["base_admittance"], grid)) == ["base_admittance", "retuned_pd"]


def test_laws_of_the_config_keep_its_reading_where_they_have_one_and_pd_is_the_last(scenario):
    """The general method has one reading alone; a law of one's own takes nothing from the section `own`."""
    own = scenario.with_overrides({"control.reading": "measured_pose"}).with_own(law={"name": "LoadTransfer"})
    found = compare.named(own, ["pd", "end_effector_admittance", "base_admittance", "LoadTransfer"])
    assert [*found] == ["end_effector_admittance", "base_admittance", "LoadTransfer", "retuned_pd"]
    readings = {name: place.control.reading for name, (place, _) in found.items()}
    assert readings["end_effector_admittance"] == "virtual_model" and readings["base_admittance"] == "measured_pose"
    assert {place.own for place, _ in found.values()} == {None}
    for laws in (["pd", "LoadTransfer"], ["LoadTransfer"]):
        assert compare.named(own, laws)["retuned_pd"] == (under_pd(own), None)
    for name in compare.HARDWARE:  # under which pd walks besides
        with pytest.raises(ConfigError, match=f"laws: expected laws of different names, got {name} twice"):
            compare.named(own, {name: "base_admittance"})


@pytest.mark.parametrize(("law", "name"), [
    ("base_admittance", "base_admittance"), ("a b/c", "a_b_c"), ("Mine.v2@1+x-y", "Mine.v2@1+x-y"), ("k=3;*", "k_3__"),
])  # fmt: skip
def test_files_of_a_law_have_its_name_without_what_no_file_has(law, name):
    assert compare.file_name(law) == name


@pytest.mark.parametrize(
    ("laws", "changes", "expected"),
    [
        (
            ["nothing"],
            {},
            "laws: expected pd, base_admittance, end_effector_admittance or a law: law: expected FILE.py",
        ),
        (["base_admittance"] * 2, {}, "laws: expected laws of different names, got base_admittance twice"),
        (["pd", "pd", "base_admittance"], {}, "laws: expected laws of different names, got pd twice"),
        ([PD()], {}, "laws: expected a law to compare with pd, got none"),
        (["pd"], {}, "laws: expected a law to compare with pd, got none"),
        ([VirtualModelAdmittance(1.0, 1.0, 1.0)] * 2, {}, "got VirtualModelAdmittance twice"),
        (["base_admittance"], {"also": ("cutoff",)}, "also: expected a gain that one of the laws has, got cutoff"),
        (["base_admittance"], {"pins": {"share": 1.0}}, "pins.share: expected a gain that one of the laws has"),
        (["base_admittance"], {"pins": {"kp": 50.0, "kd": 0.5}}, "pins: expected a gain left to search, got none"),
        (["base_admittance"], {"method": "gradient"}, "method: expected cmaes, optuna or grid"),
        (["FootOffsets"], {"pins": {"kp": 50.0}}, "optuna or grid where retuned_pd has one gain to search, got cmaes"),
        (["base_admittance"], {"joint_gains": False}, "joint_gains: expected true"),
        (
            ["base_admittance"],
            {"method": "grid", "space": "diagonal"},
            "method: expected cmaes or optuna where base_admittance has 14 numbers to search, got grid, which takes 4",
        ),
    ],
)
def test_what_is_refused(scenario, laws, changes, expected):
    with pytest.raises(ConfigError, match=expected):
        compare.contestants(scenario, laws, settings(**changes))


def test_a_method_that_nobody_chose_is_one_that_searches_all_laws_alike():
    assert compare.alike(Search(), None, {}).method == "cmaes"
    with pytest.raises(ConfigError, match="got gradient"):
        compare.alike(Search(method="gradient"), Search(method="gradient"))
    chosen = compare.alike(Search(method="optuna", starts=5), None, {}, {"method": "optuna"})
    assert (chosen.method, chosen.starts, chosen.joint_gains) == ("optuna", 5, True)
    assert chosen.iterations in (compare.FEW[1], compare.MANY[1]) and settings(iterations=3).iterations == 3
    assert compare.alike(Search(method="own"), {"method"}).method == "own"
    grid = settings(method="grid")  # points per gain are its own, and all its searches would be the same
    assert grid.starts is None and compare.seeds_for(grid, 5) == 1 and compare.seeds_for(settings(), 5) == 5


class Deaf(PD):
    """Follows the measured base, whatever the forces."""

    def step(self, state, measured, reference):
        unused = 2 * measured.wrench
        moved = reference._replace(base_position=measured.base_position)
        return super().step(state, measured._replace(wrench=unused), moved)


class Late(mc.Law):
    """Answers a force a step later."""

    def init(self, start):
        return start.reference.base_position * 0

    def step(self, state, measured, reference):
        return measured.foot_force.sum(0), shifted(reference, 1e-5 * np.ones(6) * state.sum())


@pytest.mark.parametrize(("law", "reads"), [(PD(), False), (Deaf(), False), (Late(), True), (None, True)])
def test_a_law_that_reads_forces_is_known_by_its_program(scenario, law, reads):
    assert reads_forces(Problem(scenario, law=law)) is reads


def test_better_hardware_is_half_or_twice_of_what_was_drawn(scenario):
    ensemble = Ensemble.parse(DRAWN, "drawn", members=5)
    drawn = draw(scenario, ensemble)
    found = compare.on_better_hardware(scenario, drawn)
    assert list(found) == ["half the delay", "half the friction", "twice the rate"]
    delay, friction, rate = found.values()
    np.testing.assert_allclose(delay.force_sensor.delay, drawn.force_sensor.delay / 2)
    np.testing.assert_allclose(delay.bus.command_delay, 0.002)
    np.testing.assert_allclose(friction.drive.coulomb_friction, drawn.drive.coulomb_friction / 2)
    assert (np.abs(rate.bus.control_period - drawn.bus.control_period / 2) <= 0.5e-3 + 1e-12).all()
    np.testing.assert_allclose(rate.bus.control_period / 1e-3, np.round(rate.bus.control_period / 1e-3))
    assert rate.bus.control_period.min() >= 1e-3
    for other in (friction, rate):
        np.testing.assert_array_equal(other.force_sensor.delay, drawn.force_sensor.delay)
    # a rate of one time step is as high as it gets
    fast = drawn.replace({"hardware.control_period": np.array([1e-3, 0.0, 3e-3, 5e-3, 1e-3])})
    _, _, rate = compare.on_better_hardware(scenario, fast).values()
    np.testing.assert_allclose(rate.bus.control_period, [1e-3, 0.0, 2e-3, 2e-3, 1e-3])
    ideal = mc.load_scenario(CASE, SHORT)
    assert compare.on_better_hardware(ideal, mc.parameters(ideal)) == {}


@pytest.mark.parametrize(("changes", "expected"), [({"starts": 6}, 60), ({"method": "grid", "starts": 6}, None)])
def test_a_search_has_converged_after_ten_rounds_of_its_points(scenario, monkeypatch, changes, expected):
    """Without a better one; a grid walks all of its points."""

    class Begun(Exception):
        pass

    def begun(problem, search, *, patience, **_):
        raise Begun(patience)

    monkeypatch.setattr(compare.tune, "run", begun)
    wanted = settings(**changes)
    with pytest.raises(Begun) as found:
        compare.run(compare.contestants(scenario, ["base_admittance"], wanted), Problem(scenario), wanted)
    assert found.value.args == (expected,)


COMMAND = (
    f"tune {CASE} --law base_admittance --law {{files}}/law.py:Shared --hardware dynamixel_x --also share "
    "--ensemble {files}/drawn.yaml --test-members 6 --seeds 2 --starts 4 --iterations 2 --may-be-worse-than-pd"
) + "".join(f" --set {change}" for change in SHORT)


@pytest.fixture(scope="module")
def shell(files, tmp_path_factory):
    """Return the folder of a comparison at the shell, and what it printed."""
    folder = tmp_path_factory.mktemp("compared")
    return folder, *finish(*COMMAND.format(files=files).split(), "--out", folder)


@pytest.mark.nightly
def test_the_command_writes_table_page_data_and_gains(shell, scenario):
    folder, out, _ = shell
    told = json.loads((folder / "summary.json").read_text())
    names = ["base_admittance", "Shared", "PlannedTransfer", "retuned_pd"]
    assert list(told["laws"]) == names
    assert {own["points"] for own in told["laws"].values()} == {16}
    searches = {
        (each["seed"], each["points"], each["converged"]) for law in names for each in told["laws"][law]["seeds"]
    }
    assert searches == {(0, 16, False), (1, 16, False)}
    assert told["verdict"].endswith(f"not every search of {', '.join(names)} had converged")
    assert [own["reads_forces"] for own in told["laws"].values()] == [True, True, False, False]
    page = html.unescape((folder / "report.html").read_text())
    assert told["verdict"] in out and told["verdict"][1:] in page
    assert "Gains found" in page and "peak joint torque" in page
    rows = [*names, *compare.HARDWARE, "pd"]
    data = xr.load_dataset(folder / "compared.nc", engine="h5netcdf")
    assert data["gains"].values.tolist() == rows and data["force_variation"].shape == (8, 2, 6)
    assert data["seed"].values.tolist() == [0, 1] and (data["search_converged"].sel(gains=names) == 0).all()
    for line in (*rows, "force variation", "peak foot force", "peak pull force", "cost of transport", "share lost"):
        assert line in out
    assert (folder / "compared.csv").read_text().startswith("metric,statistic,gains,value,difference,low,high,real\n")
    assert (folder / "compared.png").stat().st_size > 1000

    # the walks are those of the gains that were written, through the unseen draw
    unseen = draw(scenario, Ensemble.parse(DRAWN, "drawn", members=6, seed=1_000_003))
    gains = gains_file.load(folder / "gains-base_admittance.yaml")
    alone = mc.rollout_metrics(scenario, gains, unseen, smooth=True, dtype=np.float32)["force_variation"]
    best = int(np.argmin(data["search_value"].sel(gains="base_admittance").values))
    there = data["force_variation"].sel(gains="base_admittance", seed=best).values
    np.testing.assert_allclose(there, np.ravel(alone), rtol=2e-3)
    row = next(row for row in told["table"] if (row["metric"], row["gains"]) == ("force_variation", "base_admittance"))
    means = data["force_variation"].astype(float).mean(["seed", "member"])
    difference = means.sel(gains="base_admittance") - means.sel(gains="retuned_pd")
    assert row["difference"] == pytest.approx(float(difference), rel=1e-6)
    # of two searches nothing can be told
    assert (row["low"], row["high"], row["real"]) == (None, None, False)


@pytest.mark.nightly
def test_the_pictures_are_drawn_again(shell, tmp_path):
    for metric, name in (((), "compared"), (("--metric", "force_variation"), "judged")):
        finish("plot", shell[0], *metric, "--out", tmp_path)
        assert (tmp_path / f"{name}.png").stat().st_size > 1000


@pytest.mark.nightly
@pytest.mark.slow
def test_ctrl_c_keeps_what_was_searched_and_the_same_command_goes_on(shell, files, tmp_path):
    process = start(*COMMAND.format(files=files).split(), "--out", tmp_path)
    wait_for_parts(process, tmp_path / "parts" / "Shared-1")
    process.send_signal(signal.SIGINT)
    ((code, _, said),) = ends(process)
    assert code == 130 and "the same command goes on from there" in said
    assert len(list(tmp_path.rglob("part-*.npz"))) >= 3
    finish(*COMMAND.format(files=files).split(), "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in shell[0].iterdir()}
    same_files(tmp_path, shell[0], "compared.csv", "summary.json", "gains-Shared.yaml")


@pytest.fixture
def made_up(monkeypatch):
    """Have walks that are worked out at once: base admittance is better the nearer kp and damping are to 40 and 1e3."""
    asked = []

    def rollout_metrics(scenario, gains, parameters, *, law=None, metrics=mc.METRICS, **_):
        values = gains if isinstance(gains, dict) else vars(gains)
        off = np.log(np.asarray(values["kp"] if values.get("kp") is not None else 50.0) / 40) ** 2
        if law is not None or scenario.control.controller != "pd":
            own = np.asarray(values["damping"])[..., 0] if "damping" in values else 1e3
            off = 0.8 * off - 0.2 + 0.01 * np.log(own / 1e3) ** 2
        walk = (
            np.asarray(parameters.contact.stiffness)
            / 1e4
            * np.ones(np.asarray(parameters.drive.coulomb_friction).shape)
        )
        level = (
            1 + 0.3 * off + 0.1 * np.log(np.asarray(parameters.drive.coulomb_friction) / 0.09) + 0.1 * walk
        ).astype("f4")
        asked.append(level.shape)
        found = {name: level for name in metrics.names}
        found |= {"detached_limb": np.full(level.shape, -1), "diverged": np.zeros(level.shape, bool)}
        found["peak_utilization"] = level / 10
        lost = np.full(level.shape, -1 if law is None or type(law) is PlannedTransfer else 1)
        return found | {"sensor_lost_limb": lost, "sensor_lost_at": np.full(level.shape, 0.25)}

    def of_points(points, gains, **_):
        own = None if type(points.law) is PD else points.law
        return rollout_metrics(points.scenario, gains, points.parameters, law=own, metrics=points.table)

    monkeypatch.setattr(mc, "rollout_metrics", rollout_metrics)
    monkeypatch.setattr(mc.Simulation, "metrics", of_points)
    return asked


def test_each_search_draws_walks_of_its_own(made_up, scenario, files):
    ensemble, wanted = Ensemble.load(files / "drawn.yaml"), settings()
    first = tune.problem_of(scenario, wanted, ensemble=ensemble)
    second = tune.of_search(first, wanted, 1)
    assert tune.of_search(first, wanted, 0) is first and second.ensemble == ensemble
    friction = [np.ravel(each.parameters.drive.coulomb_friction) for each in (first, second)]
    assert not np.intersect1d(*friction).size
    assert second.objective.terms[0].baseline != first.objective.terms[0].baseline


@pytest.mark.slow
def test_an_interrupted_comparison_goes_on_with_the_same_result(made_up, scenario, files, tmp_path):
    """Ctrl-C in the second search of the second law: what was searched is not walked again."""
    opened = []

    @contextlib.contextmanager
    def stage(name, **_):
        def told(done, *_):
            if (name, done) == ("Shared, seed 1", 2):
                raise KeyboardInterrupt

        opened.append(name)
        yield told

    def run(out, stage=silent):
        ensemble = Ensemble.load(files / "drawn.yaml")
        laws = ["base_admittance", f"{files}/law.py:Shared"]
        how = {"starts": 8, "iterations": 5, "also": ("share",), "no_worse_than_pd": False}
        return tuning.compare(scenario, laws, ensemble, members=200, seeds=3, out=out, stage=stage, **how)

    whole = run(None)
    in_all = made_up.count((2, 8))
    # both of each of the judged, with pd beside them
    assert in_all == 3 * 4 * (5 + 1) and made_up.count((200, 1)) == 4 * 7
    made_up.clear()
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, stage)
    assert opened == [f"{law}, seed {seed}" for law in ("base_admittance", "Shared") for seed in (0, 1, 2)][:-1]
    assert made_up.count((2, 8)) == 4 * (5 + 1) + 2
    made_up.clear()
    found = run(tmp_path)
    assert made_up.count((2, 8)) == in_all - 26
    xr.testing.assert_identical(found.data, whole.data)
    written = tuning.write(found, tmp_path)
    assert not (tmp_path / "parts").exists()
    assert " is better than pd with its own kp and kd searched (retuned_pd, kp " in written.outcome[-1]
    assert found.laws == ["base_admittance", "Shared", "PlannedTransfer"] and found.hardware == list(compare.HARDWARE)
    table = written.summed["value"].sel(metric="force_variation", statistic="mean")
    walks = found.data["force_variation"]
    np.testing.assert_allclose(table, walks.mean(["seed", "member"]), rtol=1e-6)
    # half the friction makes all walks of retuned pd better by the same
    gain = (walks.sel(gains="half the friction") - walks.sel(gains="retuned_pd")).values
    np.testing.assert_allclose(gain, 0.1 * np.log(0.5), rtol=1e-3)
    assert "half the friction would better pd by" in written.outcome[-1]
    each = [
        f"Shared, seed {seed} ran without the force sensor of LH from 0.25 s in 200 of 200 walks" for seed in (0, 1, 2)
    ]
    lost = f"warning: {'; '.join(each)}"
    assert lost in written.outcome and lost[9:] in (tmp_path / "report.html").read_text()


def test_a_method_is_known_by_its_name():
    """What is refused then is the law."""
    with pytest.raises(ConfigError, match="nobody"):
        tuning.compare(mc.load_scenario(CASE, SHORT), ["nobody"], Ensemble(members=2), method="cmaes")
