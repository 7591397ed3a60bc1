"""What a walk is given, before anything is traced: gaits among gains, files that others name, gains by their axes."""

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, EndEffectorAdmittance, LoadTransfer, VirtualModelAdmittance
from mjx_climb.inputs.file_contents import digest, needed
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.inputs.gait_values import gait_of, own_gait, scenario_with_gait, why_fixed, with_gait
from mjx_climb.inputs.resolve import (
    by_name,
    check_robots,
    checked_dtype,
    has_gains_of_the_paper,
    recorded,
    resolve_in,
    resolved_directions,
    with_gains,
)

CASE = mc.load_scenario("case_1_2")


@pytest.mark.parametrize(
    ("values", "stride"), [({"gait.cycle": 1.0004}, 0.0125), ({"gait.cycle": 1.0004, "gait.stride": 0.03}, 0.03)]
)
def test_another_cycle_is_of_whole_steps_and_keeps_the_speed_where_no_stride_is_given(values, stride):
    assert (CASE.gait.cycle, CASE.gait.stride, CASE.time_step) == (4.0, 0.05, 1e-3)
    found = with_gait(CASE, own_parameters(CASE), values)
    np.testing.assert_allclose([found.at("gait.cycle"), found.at("gait.stride")], [1.0, stride])
    alone = scenario_with_gait(CASE, values | {"stiffness": 1.0})
    assert (alone.gait.cycle, alone.gait.stride) == (pytest.approx(1.0), pytest.approx(stride))
    assert scenario_with_gait(CASE, {"stiffness": 1.0}) is CASE and with_gait(CASE, found, {}) is found


def test_gaits_among_gains_are_those_of_the_scenario_by_their_keys():
    own = own_gait(CASE)
    assert own["gait.duty"] == 0.75 and own["gait.cycle"] == 4.0 and "gait.heading" not in own
    assert gait_of({"gait.duty": 1, "stiffness": 2, "gait.heading": 3}) == {"gait.duty": 1}


def test_a_gait_that_was_worked_out_for_its_own_values_is_fixed(tmp_path):
    low = CASE.with_overrides({"gait.swing": "low_reaction"})
    assert why_fixed(CASE, ["gait.cycle", "gait.duty"]) == ""
    assert why_fixed(low, ["gait.duty"]) == (
        "gait.duty: expected none, as gait.swing: low_reaction is computed for the scenario's own gait"
    )
    np.save(tmp_path / "map.npy", np.zeros((2, 2)))
    ground = {"file": str(tmp_path / "map.npy"), "resolution": 9.0, "origin": [-4.5, -4.5]}
    mapped = CASE.with_overrides({"ground.map": ground})
    for key in own_gait(CASE):
        fixed = f"{key}: expected none, as a map's footholds are computed for the scenario's own gait"
        assert why_fixed(mapped, ["gait.duty", key]) == (fixed if key in ("gait.cycle", "gait.stride") else "")
    with pytest.raises(ValueError, match=r"^gains.gait.duty: expected none, as gait.swing"):
        with_gait(low, own_parameters(low), {"gait.duty": 0.8})


def test_of_a_batch_of_gaits_the_extremes_are_checked():
    with_gait(CASE, own_parameters(CASE), {"gait.duty": np.array([0.8, 0.76, 0.9])})
    # the shortest swing is of a robot that has neither the longest stance nor the shortest cycle
    short = {"gait.duty": np.array([0.75, 0.9980, 0.9985]), "gait.cycle": np.array([0.8, 0.9, 4.0])}
    with pytest.raises(ValueError, match=r"^gains.gait.duty: expected a swing, \(1 - duty\) cycle, of two time steps"):
        with_gait(CASE, own_parameters(CASE), short)
    for wrong in ([0.8, 0.5, 0.9], [0.8, 0.9, 1.0]):
        with pytest.raises(ValueError, match=r"^gains.gait.duty: expected"):
            with_gait(CASE, own_parameters(CASE), {"gait.duty": np.array(wrong)})


# ---------------------------------------------------------------------------------------------------------------- files


def test_a_file_of_python_needs_the_modules_and_packages_beside_it_that_it_imports(tmp_path):
    (tmp_path / "law.py").write_text("import helper\nfrom parts.gears import teeth\nimport numpy\nfrom . import near\n")
    (tmp_path / "helper.py").write_text("import further\n")
    (tmp_path / "further.py").write_text("import helper\n")
    (tmp_path / "other.py").write_text("")
    (tmp_path / "parts").mkdir()
    for name in ("__init__", "gears", "teeth"):
        (tmp_path / "parts" / f"{name}.py").write_text("")
    found = {path.relative_to(tmp_path).as_posix() for path in needed(tmp_path / "law.py")}
    assert found == {"law.py", "helper.py", "further.py", "parts/__init__.py", "parts/gears.py", "parts/teeth.py"}
    before = digest(tmp_path / "law.py")
    (tmp_path / "other.py").write_text("x = 1\n")
    assert digest(tmp_path / "law.py") == before
    (tmp_path / "further.py").write_text("import helper  # \n")
    assert digest(tmp_path / "law.py") != before
    (tmp_path / "same.py").write_bytes((tmp_path / "law.py").read_bytes())
    assert digest(tmp_path / "same.py") != digest(tmp_path / "law.py")  # by its name
    (tmp_path / "broken.py").write_text("def (")
    assert [path.name for path in needed(tmp_path / "broken.py")] == ["broken.py"]


def test_a_description_needs_what_it_includes_and_no_visual_meshes(tmp_path):
    (tmp_path / "robot.xml").write_text('<mujoco><include file="leg.xml"/><worldbody><body><freejoint/>'
                                        '<geom size="0.1" mass="1"/></body></worldbody></mujoco>')  # fmt: skip
    (tmp_path / "leg.xml").write_text("<mujoco/>")
    assert [path.name for path in needed(tmp_path / "robot.xml")] == ["leg.xml", "robot.xml"]
    before = digest(tmp_path / "robot.xml")
    (tmp_path / "leg.xml").write_text("<mujoco><!-- --></mujoco>")
    assert digest(tmp_path / "robot.xml") != before
    with pytest.raises(mc.ConfigError, match="expected a readable file"):
        digest(tmp_path / "none.yaml")


# ---------------------------------------------------------------------------------------------------------------- gains


def test_gains_of_six_axes_are_cut_for_a_law_of_translations():
    six = mc.Gains(np.arange(1.0, 7), np.arange(2.0, 8), np.arange(3.0, 9))
    found = resolve_in(CASE, EndEffectorAdmittance(), six, None, np.float64)
    np.testing.assert_array_equal(found.law.damping, [2.0, 3.0, 4.0])
    stored = recorded(CASE, six, found)
    np.testing.assert_array_equal(stored.damping, np.arange(2.0, 8))
    alone = resolve_in(CASE, EndEffectorAdmittance(), {"damping": 9.0}, None, np.float64)
    stored = recorded(CASE, {"damping": 9.0}, alone)
    np.testing.assert_array_equal(stored.damping, [9.0] * 3 + [CASE.control.damping] * 3)
    assert resolve_in(CASE, PD(), six, None, np.float64).shape == ()
    with pytest.raises(ValueError, match=r"gains.masses: expected one of .*, the gains of PD"):
        resolve_in(CASE, PD(), {"masses": 1.0}, None, np.float64)


def test_gains_of_the_joint_loop_go_to_the_parameters():
    found = resolve_in(CASE, VirtualModelAdmittance(), {"kp": 40.0, "kd": 0.0, "gait.duty": 0.8}, None, np.float32)
    assert (float(found.parameters.joint_loop.kp), float(found.parameters.joint_loop.kd)) == (40.0, 0.0)
    assert found.called == {"control.kp": "gains.kp", "control.kd": "gains.kd", "gait.duty": "gains.gait.duty"}
    assert float(found.own.joint_loop.kp) == CASE.control.kp and float(found.own.at("gait.duty")) == 0.8
    for name, value in (("kp", 0.0), ("kp", -1.0), ("kd", -1.0)):
        with pytest.raises(ValueError, match=rf"gains.{name}: expected finite numbers"):
            resolve_in(CASE, PD(), {name: value}, None, np.float32)


def test_gains_of_no_law_still_say_how_many_robots_walk():
    six = {name: np.full((5, 6), 10.0) for name in mc.Gains.AXES}
    found = resolve_in(CASE, PD(), six, None, np.float64)
    assert found.shape == (5,) and found.parameters.mass_scale.shape == (5,)
    check_robots((2, 3))
    with pytest.raises(ValueError, match="expected one robot or more"):
        check_robots((2, 0))
    with pytest.raises(ValueError, match="expected float32 or float64, got float16"):
        checked_dtype(np.float16)


def test_laws_have_the_gains_of_the_paper_or_their_own():
    assert has_gains_of_the_paper(PD()) and has_gains_of_the_paper(EndEffectorAdmittance())
    assert not has_gains_of_the_paper(LoadTransfer())
    law = with_gains(LoadTransfer(), {"leak": 2.0, "kp": 5.0})
    assert law.leak == 2.0 and by_name(law)["leak"] == 2.0
    assert by_name(mc.Gains(1.0, 2.0, 3.0)) == {"inertia": 1.0, "damping": 2.0, "stiffness": 3.0}


def test_directions_have_an_axis_before_those_of_the_robots():
    gains = {"damping": np.full((4, 6), 10.0), "kp": np.full(4, 50.0)}
    resolved = resolve_in(CASE, VirtualModelAdmittance(), gains, None, np.float64)
    rates = {"damping": np.arange(2 * 4 * 6.0).reshape(2, 4, 6), "kp": np.ones((2, 4))}
    found = resolved_directions(resolved, gains, rates)
    np.testing.assert_array_equal(found["damping"], np.moveaxis(rates["damping"], 0, 1))
    assert found["kp"].shape == (4, 2)
    shared = resolved_directions(resolved, gains, {"damping": np.ones((2, 1, 6)), "kp": np.ones((2, 1))})
    assert shared["damping"].shape == (4, 2, 6) and shared["kp"].shape == (4, 2)
    alike = resolved_directions(resolved, gains, {"damping": np.arange(8.0).reshape(2, 4, 1)})["damping"]
    np.testing.assert_array_equal(alike, np.broadcast_to(np.arange(8.0).reshape(2, 4, 1).swapaxes(0, 1), (4, 2, 6)))
    for rates, said in (({"damping": np.ones((2, 6))}, r"damping: expected shape \(2, 4, 6\)"),
                        ({"damping": np.ones((3, 4, 6)), "kp": np.ones((2, 4))}, r"kp: expected shape \(3, 4\)"),
                        ({"damping": np.ones((2, 3, 6))}, r"damping: expected shape \(2, 4, 6\)")):  # fmt: skip
        with pytest.raises(ValueError, match=rf"directions.{said}, or axes of 1 behind the first"):
            resolved_directions(resolved, gains, rates)
    for name in ("gait.cycle", "gait.duty"):
        with pytest.raises(
            ValueError, match=rf"directions.{name}: expected none, as it is counted in whole time steps"
        ):
            resolved_directions(resolved, gains, {name: np.ones((2, 4))})
        still = {name: np.zeros((2, 4)), "kp": np.ones((2, 4))}
        assert {*resolved_directions(resolved, gains, still)} == {"kp"}
    one = resolve_in(CASE, VirtualModelAdmittance(), {"kp": 50.0}, None, np.float64)
    with pytest.raises(ValueError, match=r"^directions.kp: expected shape \(1,\), got \(\)$"):
        resolved_directions(one, {"kp": 50.0}, {"kp": 1.0})
    own, other = mc.Gains(1.0, 2.0, 3.0, kp=50.0), mc.Gains(*(np.ones((1, 6)),) * 3)
    with pytest.raises(ValueError, match=r"directions.kp: expected rates of change, as gains.kp is given, got None"):
        resolved_directions(resolve_in(CASE, VirtualModelAdmittance(), own, None, np.float64), own, other)
