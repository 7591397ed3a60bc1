"""Whole commands about one walk, a robot's file or its log: all that they print and leave, against approved texts."""

import dataclasses
from pathlib import Path

import pytest

from mjx_climb.viz import rendering
from mjx_climb.viz.rendering import backend
from tests import approved, left
from tests.robot.test_proposal import dog
from tests.tuning.identification import stand_in_mujoco
from tests.walk.reference_walks import scenario_of
from tuning.identification.readers import write_csv

pytestmark = pytest.mark.slow

APPROVED = Path(__file__).parent / "approved"
UNEVEN, MAPPED = "gripper on uneven ground, noisy sensors", "held places of a map, a robot that leans"
STAND = dataclasses.replace(stand_in_mujoco.TRUTH, delay=0.004, mass=0.05, heavier=1.1)
STANDING = " ".join(f"--set {each}" for each in (
    "gravity=[0.5,-0.3,-9.7]", "control.kp=45", "control.kd=0.25", "hardware.command_delay=0.003",
    "hardware.servo.armature=0.01", "hardware.servo.coulomb_friction=0.04", "hardware.servo.viscous_friction=0.02",
))  # fmt: skip
CASES = {  # in the order in which one needs what another has left
    "run": "run uneven.yaml --mcap --snapshots --at 0.05,0.25 --size 320x240 --figures svg --json",
    "run_mapped": "run mapped.yaml --figures svg --set duration=0.75",
    "plot": "plot run --figures svg --figure-size 90x120",
    "replay": "replay uneven.yaml --log run/walk.mcap --figures svg --with-law",
    "replay_stand": f"replay case_1_2 --log stand.csv --figures svg --mass 0.05 --base held {STANDING}",
    "excite": "excite case_1_1 --duration 2 --candidates 2 --seed 3 --drop --mass 0.1 --kp 40 --kp 60 --high 6 "
    "--fit hardware.servo.armature --fit hardware.servo.coulomb_friction --figures svg",
    "robot": "robot dog.xml --write robot/dog.yaml --slope 20 --gravity 0.3",
    "robot_stand": "robot bench.xml --stand --write robot_stand/bench.yaml",
}  # fmt: skip
BENCH = """<mujoco><worldbody><body name="rod"><joint name="servo" axis="0 1 0" range="-90 90"/>
<inertial pos="0.1 0.002 0" mass="0.12" diaginertia="1e-5 4e-4 4e-4"/><body name="weight" pos="0.2 0 0">
<inertial pos="0 0 0" mass="0.5" diaginertia="2e-4 2e-4 2e-4"/></body></body></worldbody>
<actuator><motor joint="servo" forcerange="-2 2"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with configs, logs and robots."""
    try:
        backend.find()  # pictures are asked for
    except rendering.RenderingError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("files")
    for name, scenario in (("uneven", UNEVEN), ("mapped", MAPPED)):
        (folder / f"{name}.yaml").write_text(scenario_of(scenario, folder).to_yaml())
    log = stand_in_mujoco.log_of(STAND, 2.0, kinds=("position", "velocity", "effort"))
    write_csv(folder / "stand.csv", stand_in_mujoco.columns_of(log))
    (folder / "dog.xml").write_text(dog())
    (folder / "bench.xml").write_text(BENCH)
    return folder


@pytest.mark.parametrize("name", CASES)
def test_a_whole_command_leaves_what_was_approved(name, folder, call, monkeypatch):
    monkeypatch.chdir(folder)
    arguments = CASES[name].split()
    (folder / name).mkdir()
    out = [] if arguments[0] == "robot" else ["--out", name]
    ended = call(*arguments, *out)
    approved.check_numbers(APPROVED / f"{name}.txt", left.of_command(*ended, folder / name, folder))
