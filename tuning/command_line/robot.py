"""`mjx-climb robot`: a robot's own file, made ready to walk."""

from pathlib import Path
from typing import Annotated

import typer


def robot(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MJCF (.xml) or URDF (.urdf) of the robot.")],
    write: Annotated[
        Path | None,
        typer.Option(metavar="CONFIG", help="Scenario to write, ready for run.", show_default="print it"),
    ] = None,
) -> None:
    """Propose a scenario for the robot in an MJCF or URDF: base, limbs, feet, stance, gait and time step.

    Limbs are the rows of two to seven joints that start at one base and end in what is called a foot, or the like. The
    stance is a keyframe's, or searched. Stride, grip and gains are HubRobo's in proportion to mass and reach. Prints
    what was taken from the file, changed and ignored, each with the reason; then the scenario, for you to look through.

    \b
    Examples:
      mjx-climb robot go2.xml
      mjx-climb robot anymal.urdf --write anymal.yaml
    """
    import mjx_climb as mc
    from mjx_climb.checks.time_step import largest_time_step
    from mjx_climb.files import dataset
    from mjx_climb.robot.proposal import propose

    if write is not None and write.resolve() == file.resolve():
        raise mc.ConfigError(f"{write}: expected another file than the robot's own")
    proposal = propose(file)
    scenario = mc.Scenario.model_validate({**proposal.sections, "time_step": 0.001})
    step = min(0.001, largest_time_step(scenario, str(file)))
    scenario = scenario.with_overrides({"time_step": step})
    rows = [*proposal.notes, ("changed", f"time step {step:g} s", "short enough for contacts and joint loop")]
    kind, what = (max(len(row[n]) for row in rows) for n in (0, 1))
    for row in rows:
        typer.echo(f"{row[0]:{kind}}  {row[1]:{what}}  {row[2]}")
    if write is None:
        typer.echo("\n" + scenario.to_yaml(), nl=False)
        return
    dataset.write_text_atomically(write, scenario.relative_to(write.absolute().parent).to_yaml())
    typer.echo(f"\nwrote {write}: mjx-climb run {write}")
