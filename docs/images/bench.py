"""Draw docs/images/bench.png: a recording of an XL-330 with a pendulum beside its shipped profile."""

import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import mjx_climb as mc
from mjx_climb.scenario.load import load_hardware, with_hardware
from tuning.identification.model import replay
from tuning.identification.readers.log import Log, Signal

ROOT = Path(__file__).parents[2]
PENDULUM = """<mujoco><worldbody><body name="rod"><joint name="swing" axis="0 -1 0" range="-3 3" limited="true"/>
<inertial pos="0 0 -0.1" mass="0.49" diaginertia="1e-6 1e-6 1e-6"/></body></worldbody></mujoco>"""


def main() -> None:
    """Replay the chirp at a P register of 400 and draw both."""
    with np.load(ROOT / "tests/reference/xl330_bench.npz") as of:
        time, goal, angle = of["p400_sin_time_square"].astype(float).T
    with tempfile.TemporaryDirectory() as folder:
        (file := Path(folder) / "pendulum.xml").write_text(PENDULUM)
        config = {"robot": {"file": str(file), "limbs": {"rod": {"joints": ["swing"]}}}}
        bench = with_hardware(mc.Scenario().with_overrides(config), load_hardware("xl_330"))
        bench = bench.with_overrides({"hardware.servo.registers": {"p": 400}, "hardware.servo.supply_voltage": 7.4})
        log = Log({"rod.swing.command": Signal(time, goal), "rod.swing.position": Signal(time, angle)}, "bench")
        walk = replay.simulate(replay.prepare(log, bench, "held", 0.0)).walk
    found = np.interp(time, walk.time, walk.joint_angles[:, 0, 0])
    figure, (above, below) = plt.subplots(
        2, sharex=True, figsize=(5, 3.2), height_ratios=(2, 1), layout="constrained", dpi=100
    )
    above.plot(time, np.degrees(goal), color="0.7", label="goal")
    above.plot(time, np.degrees(angle), color="black", label="recorded")
    above.plot(time, np.degrees(found), color="#0072b2", linewidth=1.0, label="simulated")
    below.plot(time, np.degrees(angle - found), color="#0072b2", linewidth=1.0)
    above.set_ylabel("angle [deg]")
    below.set(xlabel="time [s]", ylabel="error [deg]")
    above.legend(ncols=3, loc="upper left", fontsize="small")
    figure.savefig(ROOT / "docs/images/bench.png")


if __name__ == "__main__":
    main()
