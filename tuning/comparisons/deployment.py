"""Whether gains may go to the robot: objections on the scenario's own hardware."""

import mjx_climb as mc
from mjx_climb.inputs.resolve import AnyGains
from mjx_climb.physics.equations_of_motion import DEFAULT_ENGINE
from tuning.background import Stage, silent
from tuning.comparisons import margins, stability_limit


def check(
    scenario: mc.Scenario,
    gains: AnyGains,
    source: str,
    *,
    law: mc.Law | None = None,
    engine: str = DEFAULT_ENGINE,
    stage: Stage = silent,
) -> list[str]:
    """Return warnings, a margin of less than twice the hardware each; `law` None: the gains are of the scenario's.

    A robot stands on all its feet before it walks, also where its gait has no such stance: gains hold there too.

    Raises:
        ConfigError: in one line that begins with `source`, gains with which the loop is unstable in some stance, or a
            walk fails, on the very hardware of the scenario.
    """
    standing = scenario.with_overrides({"gait.duty": 1 - 2 * scenario.time_step / scenario.gait.cycle})
    for where, walked in (("about a stance of the gait", scenario), ("of a robot that stands on all feet", standing)):
        with stage(f"disturbances {where}"):
            radius = float(stability_limit.spectral_radius(walked, gains, law=law, engine=engine).max())
        if radius > 1 + stability_limit.ROUNDING:
            got = f"a disturbance {where} that grows by {radius:.6f} a time step"
            raise mc.ConfigError(source, "", "gains that are stable on the config's hardware", got)
    with stage("walks on worse hardware") as told:
        found = margins.find(scenario, gains, law=law, engine=engine, progress=told)
    if not found.holds:
        got = "a walk that loses a gripper or diverges"
        raise mc.ConfigError(source, "", "gains that hold on the config's hardware", got)
    return margins.warnings(found)
