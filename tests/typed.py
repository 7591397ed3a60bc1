"""Calls as a type checker sees them: `make types` fails where it takes a wrong keyword, or refuses a right one."""

import mjx_climb as mc

mc.Scenario(duration=3.0, time_step=2e-3, gait={"cycle": 2.0})
mc.Scenario(durations=3.0)  # type: ignore[call-arg]
