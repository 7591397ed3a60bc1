"""Load transfer for a robot: the law in C++ takes the same steps as here, with the parameters that are written."""

import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import mjx_climb as mc
from mjx_climb.control import LoadTransfer, Measurement, Reference, Start, sensor_watch
from tuning.comparisons import deployment
from tuning.gains import load_transfer

COMPILER = shutil.which("g++") or shutil.which("clang++")
STEPS, PERIOD, SAFE_KP = 400, 0.005, 34.5
# all of them matter in a walk of random scenes: offsets and rates meet their bounds now and then
LAW = LoadTransfer(
    normal_damping=87.3, tangential_damping=112.1, leak=0.31, leveling=0.93, unloading=0.21, loading=0.37,
    landing=0.83, pull_limit=0.54, max_offset=0.0061, max_rate=0.057,
    torque_limit=2.3,
)  # fmt: skip


def quaternions(random, mean, size):
    """Unit quaternions (STEPS, 4) around others."""
    found = mean + random.normal(0, size, (STEPS, 4))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def scenes(limbs):
    """Measurements and references of STEPS instants, one foot or more on the ground in each."""
    random = np.random.default_rng(limbs)
    around = np.arange(limbs) * 2 * np.pi / limbs
    stance = 0.2 * np.stack([np.cos(around), np.sin(around), np.full(limbs, -0.5)], axis=1)
    position, orientation = random.normal(0, 1, (STEPS, 3)), quaternions(random, [1, 0, 0, 0], 0.5)
    foot = position[:, None] + stance + random.normal(0, 0.02, (STEPS, limbs, 3))
    # supports and loads that last a while
    support, load = np.ones((STEPS, limbs), bool), np.zeros((STEPS, limbs, 3))
    for start in range(0, STEPS, 40):
        support[start : start + 40, random.permutation(limbs)[: int(limbs * random.random() ** 2)]] = False
        load[start : start + 40] = random.normal([0, 0, 3], [6, 6, 9], (limbs, 3))
    times = random.exponential(0.3, (2, STEPS, limbs)) * support
    force = (load + random.normal(0, 2, load.shape)) * support[..., None]
    base = position + random.normal(0, 0.01, (STEPS, 3)), quaternions(random, orientation, 0.02)
    for dead in (0.0, np.nan, np.inf):
        force[random.random(support.shape) < 0.02] = dead
    force[50:90, 0] = force[250:, 1] = 0.0  # for a while, and for good
    unread, torque = np.zeros(STEPS), random.normal(0, 1, (STEPS, limbs, 3))
    measured = Measurement(*base, unread, unread, force, unread, support, unread, unread, torque, unread == 0, unread)
    return measured, Reference(position, orientation, foot, *times)


@jax.jit
def here(law, scenes):
    """The foot targets (STEPS, limb, 3) of the law in Python, and kp of joints that have 20 N m/rad."""

    def step(state, scene):
        (watch, own), (measured, reference) = state, scene
        watch, force, known = sensor_watch.watched(watch, measured.foot_force, measured.support, PERIOD)
        own, command = law.step(own, measured._replace(foot_force=force, forces_known=known), reference)
        kp = sensor_watch.raised_kp(jnp.asarray(20.0), jnp.asarray(SAFE_KP), watch.kp_rise)
        return (watch, own), (command.foot_position, kp)

    start = Start(PERIOD, jax.tree.map(lambda value: value[0], scenes[1]))
    state = sensor_watch.begin(start.reference.foot_position), law.init(start)
    return jax.lax.scan(step, state, scenes)[1]


@pytest.fixture(scope="module")
def there(tmp_path_factory):
    """The same of the law in C++, from the files that are exported."""
    folder = tmp_path_factory.mktemp("exported")
    for name, text in load_transfer.texts(LAW, PERIOD, given={"safe_kp": SAFE_KP}).items():
        (folder / name).write_text(text)

    def there(measured, reference):
        limbs = measured.support.shape[1]
        program, driver = folder / f"driver_{limbs}", Path(__file__).with_name("load_transfer_driver.cpp")
        flags = "-std=c++17 -O2 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Werror".split()
        command = [COMPILER, *flags, f"-I{folder}", f"-DLIMBS={limbs}", driver, "-o", program]
        compiled = subprocess.run(command, capture_output=True, text=True)
        assert compiled.returncode == 0, compiled.stderr
        peak = np.abs(measured.joint_torque).max(2)
        fields = (*measured[:2], measured.foot_force, measured.support, peak, *reference)
        scenes = np.concatenate([np.reshape(field, (STEPS, -1)) for field in fields], axis=1, dtype=np.float64)
        out = subprocess.run([program], input=scenes.tobytes(), capture_output=True, check=True).stdout
        rows = np.frombuffer(out).reshape(STEPS, -1)
        return rows[:, :-2].reshape(STEPS, limbs, 3), rows[:, -2:].T

    return there


@pytest.mark.slow
@pytest.mark.skipif(COMPILER is None, reason="no C++ compiler")
@pytest.mark.parametrize("limbs", [4, pytest.param(6, marks=pytest.mark.nightly)])
def test_the_law_in_cpp_takes_the_steps_of_the_law_here(there, limbs):
    """Offsets to 1e-10 of the largest: what a reference in metres rounds is a part of them."""
    measured, reference = scenes(limbs)
    (feet, expected_kp), (got, (kp, stiff)) = here(LAW, (measured, reference)), there(measured, reference)
    expected, got = feet - reference.foot_position, got - reference.foot_position
    assert kp[0] == 20 and kp[-1] > 30 and len(np.unique(kp)) > 50
    np.testing.assert_allclose(kp, expected_kp, rtol=1e-12)
    assert (stiff == 50).all()  # kp is raised, never lowered
    bounded = np.isclose(np.linalg.norm(expected, axis=-1)[measured.support], LAW.max_offset)
    assert 0.01 < bounded.mean() < 0.5  # the scenes show the law at its bound, and within
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


@pytest.fixture
def export(tmp_path, call, monkeypatch):
    """Export gains of LAW with some keys changed, None: left out; walks are taken to hold, and kept in `checked`."""
    checked = []
    monkeypatch.setattr(deployment, "check", lambda *given, **how: checked.append((given, how)) or [])

    def export(*arguments, **changes):
        values = {"law": "LoadTransfer"} | {name: getattr(LAW, name) for name in LAW.GAINS} | changes
        file = tmp_path / "gains.yaml"
        file.write_text(yaml.safe_dump({name: value for name, value in values.items() if value is not None}))
        return *call("export", file, *arguments), checked

    return export


def test_what_is_written_is_what_the_file_has_to_the_last_digit(export, tmp_path):
    """In YAML and in C++, beside the law as it is here; times and joint gains are those of the walk."""
    digits = {"leak": 0.1 + 0.2, "pull_limit": 1e-7 / 3, "normal_damping": 1e22, "kp": 34.5}
    limits = {"max_offset": 0.013, "torque_limit": 1.7}
    folder = tmp_path / "robot"
    code, out, err, checked = export(
        "--config", "case_1_2", "--hardware", "dynamixel_x", "--out", folder, limits=limits, **digits
    )
    assert (code, out) == (0, "") and err.startswith("wrote ") and len(err.splitlines()) == 1
    assert all(
        str(folder / name) in err for name in ("load_transfer.yaml", "load_transfer_gains.hpp", load_transfer.LAW.name)
    )
    assert {file.name for file in folder.iterdir()} == {
        "load_transfer.yaml",
        "load_transfer_gains.hpp",
        "load_transfer.hpp",
    }
    (((scenario, gains, _), how),) = checked
    assert isinstance(how["law"], LoadTransfer) and how["law"].max_offset == 0.013
    assert scenario.hardware.control_period == 0.005
    written = yaml.safe_load((folder / "load_transfer.yaml").read_text())
    own = {"max_offset": 0.013, "max_rate": 0.1, "torque_limit": 1.7, "safe_kp": 50.0}
    expected = {"period": 0.005} | {name: getattr(LAW, name) for name in LAW.GAINS} | own | digits
    assert expected.pop("kp") == written["walked"]["kp"] == gains["kp"]
    assert written["load_transfer"] == expected
    assert written["walked"]["hardware"] == scenario.hardware.model_dump(mode="json")
    cpp = re.findall(r"gains\.(\w+) = (.*);", (folder / "load_transfer_gains.hpp").read_text())
    assert {
        name: float(value.replace("std::numeric_limits<double>::infinity()", "inf")) for name, value in cpp
    } == expected
    assert (folder / "load_transfer.hpp").read_bytes() == load_transfer.LAW.read_bytes()


def test_without_a_folder_the_parameters_are_printed(export):
    code, out, err, checked = export("--update-rate", 250, kd=1.66, gait={"duty": 0.8})
    assert (code, checked, len(err.splitlines())) == (0, [], 1) and "these gains were not walked" in err
    written = yaml.safe_load(out)
    assert written["load_transfer"]["period"] == 1 / 250 and written["given"] == {"kd": 1.66, "gait.duty": 0.8}


@pytest.mark.parametrize(
    ("given", "walked", "safe_kp"),
    [({"safe_kp": SAFE_KP}, None, SAFE_KP), ({}, None, 50.0), ({}, 70.0, 70.0), ({"safe_kp": SAFE_KP}, 70.0, 70.0)],
)
def test_the_joint_gain_without_a_sensor_is_given_or_of_the_config_that_was_walked(given, walked, safe_kp):
    scenario = walked and mc.load_scenario("case_1_2", {"control.safe_kp": walked})
    found = load_transfer.texts(LAW, PERIOD, scenario, given)
    assert yaml.safe_load(found["load_transfer.yaml"])["load_transfer"]["safe_kp"] == safe_kp
    assert f"gains.safe_kp = {safe_kp!r};" in found["load_transfer_gains.hpp"]


def test_each_parameter_has_its_unit_and_what_is_given_stands_below():
    files = load_transfer.texts(LAW, PERIOD, given={"kp": 40.0})
    units = {"period": "s", "max_offset": "m", "max_rate": "m/s", "torque_limit": "N m", "safe_kp": "N m/rad"}
    units |= {name: field.unit for name, field in LAW.GAINS.items()}
    text = files["load_transfer.yaml"]
    assert dict(re.findall(r"^  (\w+): \S+  # ([^,]+), ", text, re.MULTILINE)) == units
    assert dict(re.findall(r"  gains\.(\w+) = .*;  // (.*)", files["load_transfer_gains.hpp"])) == units
    assert yaml.safe_load(text)["given"] == {"kp": 40.0} and f"every {PERIOD:g} s" in text
    assert "given" not in yaml.safe_load(load_transfer.texts(LAW, PERIOD)["load_transfer.yaml"])


def test_the_gait_of_the_file_is_walked_and_written(export):
    """At the config's speed of travel: half the cycle, half the stride."""
    _, out, _, checked = export("--config", "case_1_2", gait={"duty": 0.8, "cycle": 2.0})
    (((scenario, *_), _),) = checked
    gait = yaml.safe_load(out)["walked"]["gait"]
    assert gait == scenario.gait.model_dump(mode="json") and (gait["duty"], gait["cycle"]) == (0.8, 2.0)
    assert gait["stride"] == pytest.approx(mc.load_scenario("case_1_2").gait.stride / 2)


def test_a_filter_that_the_law_had_is_said(export, tmp_path):
    (tmp_path / "config.yaml").write_text(mc.load_scenario("case_1_2", {"hardware.force_sensor.filter": 30}).to_yaml())
    code, _, err, _ = export()
    assert code == 0 and "filters nothing: give it forces behind a low pass of 30 Hz" in err


@pytest.mark.parametrize(
    ("arguments", "changes", "expected"),
    [
        (("--format", "json"), {}, "--format: expected none with gains of LoadTransfer"),
        ((), {"leak": -1.0}, "leak: expected"),
        ((), {"leak": None}, "leak: expected a value, got none"),
        (
            (),
            {"limits": {"max_pull": 1}},
            "limits.max_pull: expected only the keys max_offset, max_rate, torque_limit",
        ),
        ((), {"limits": {"max_rate": 0}}, "limits.max_rate: expected a number above 0, got 0"),
        ((), {"law": [1]}, "law: expected gains of the config's law, got those of [1]"),
        ((), {"law": "mine.py:Law"}, "law: expected gains of the config's law, got those of mine.py:Law"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(export, arguments, changes, expected):
    code, out, err, checked = export(*arguments, **changes)
    assert (code, out, checked, len(err.splitlines())) == (2, "", [], 1) and expected in err
