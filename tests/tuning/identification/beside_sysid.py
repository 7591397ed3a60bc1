"""Beside `mujoco.sysid` on a chain in the air, errors and times: python -m tests.tuning.identification.beside_sysid.

Armature and dry friction of each joint, from a start on their lower bound, zero; positions and velocities with noise;
kp, kd and the delay of commands are known to both, and the state at the start to `mujoco.sysid`. Without a delay
commands jump as samples are taken.
"""

import functools
import time

import mujoco
import numpy as np
from mujoco import sysid

import mjx_climb as mc
import tuning
from tests.tuning.identification.stand_in_mujoco import JOINTS, NOISE, Truth, log_of, welded_spec

STEP = 0.001  # s, of both
DELAYS = (0.0, 0.004)  # s, of commands


def truth_of(seed, delay):
    """Return a robot whose joints all differ."""
    rng = np.random.default_rng(seed)
    return Truth(rng.uniform(0.006, 0.02, 12), rng.uniform(0.03, 0.1, 12), 0.0, 40.0, 0.3, delay)


def by_sysid(truth, log, optimizer="mujoco"):
    """Return armatures and frictions (12,) each."""
    spec = welded_spec("hubrobo_v3_2", truth)
    names = [joint.replace(".", "_") for joint in JOINTS]
    for name in names:
        spec.add_sensor(
            name=f"{name}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name
        )
        spec.add_sensor(
            name=f"{name}_vel", type=mujoco.mjtSensor.mjSENS_JOINTVEL, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name
        )
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model = spec.compile()
    data = mujoco.MjData(model)
    command = [log.signals[f"{joint}.command"] for joint in JOINTS]
    data.qpos[:] = [signal.value[0] for signal in command]
    initial = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
    fine = np.arange(round(log.duration / STEP) + 1) * STEP
    held = np.maximum(np.searchsorted(command[0].time, fine - truth.delay + 1e-9, side="right") - 1, 0)
    control = np.stack([signal.value[held] for signal in command], axis=1)
    sensed = [log.signals[f"{joint}.{kind}"] for joint in JOINTS for kind in ("position", "velocity")]
    measured = np.stack([signal.value for signal in sensed], axis=1)
    params = sysid.ParameterDict()
    for name in names:
        for field, most in (("armature", 0.1), ("frictionloss", 0.5)):
            set_one = functools.partial(lambda s, p, n, f: setattr(s.joint(n), f, p.value[0]), n=name, f=field)
            params.add(sysid.Parameter(f"{name}_{field}", nominal=0.0, min_value=0.0, max_value=most, modifier=set_one))
    sequences = sysid.ModelSequences(
        "stand", spec, "chirp", initial, sysid.TimeSeries(fine, control),
        # a row of its rollout has the sensors of the step before
        sysid.TimeSeries.from_names(sensed[0].time[1:-1] + STEP, measured[1:-1], model),
    )  # fmt: skip
    weights = {
        f"{name}_{kind}": 1 / NOISE[kind_]
        for name in names
        for kind, kind_ in (("pos", "position"), ("vel", "velocity"))
    }
    found, _ = sysid.optimize(
        initial_params=params, optimizer=optimizer,
        residual_fn=sysid.build_residual_fn(models_sequences=[sequences], sensor_weights=weights), verbose=False,
    )  # fmt: skip
    return tuple(
        np.array([found[f"{name}_{field}"].value[0] for name in names]) for field in ("armature", "frictionloss")
    )


def by_identify(truth, log):
    """Return armatures and frictions (12,) each."""
    known = {"control.kp": 40.0, "control.kd": 0.3, "hardware.command_delay": truth.delay}
    scenario = mc.Scenario().with_overrides(known)
    found = tuning.identify(scenario, log, ["robot.*.armature", "robot.*.friction"], starts=1, held_out=0.0)
    return tuple(
        np.array([found.estimates[f"robot.{joint}.{field}"].value for joint in JOINTS])
        for field in ("armature", "friction")
    )


def main():
    for delay in DELAYS:
        truth = truth_of(0, delay)
        log = log_of(truth, 6.0)
        for name, fit in (("identify", by_identify), ("identify, again", by_identify), ("mujoco.sysid", by_sysid)):
            begin = time.process_time()
            errors = errors_of(truth, fit(truth, log))
            took = time.process_time() - begin
            shown = f"armature {errors[0]:.2%}, friction {errors[1]:.2%} (rms)"
            print(f"{1e3 * delay:g} ms, {name:16} {shown}, {took:.0f} s of a processor", flush=True)


def errors_of(truth, found):
    """Return the errors of armatures and frictions, root mean squares over the truth."""
    both = zip(found, (truth.armature, truth.friction), strict=True)
    return [np.sqrt(np.mean((value / true - 1) ** 2)) for value, true in both]


if __name__ == "__main__":
    main()
