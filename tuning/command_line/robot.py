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
    gravity: Annotated[
        float,
        typer.Option(min=0.0, metavar="M/S2", help="Gravity on level ground, m/s^2; on the Moon 1.62."),
    ] = 9.81,
    base: Annotated[
        str | None,
        typer.Option(metavar="BODY", help="Body that the limbs begin at.", show_default="found"),
    ] = None,
    limbs: Annotated[
        str | None,
        typer.Option(metavar="NAME,NAME,...", help="Limbs to stand on; others are held.", show_default="all"),
    ] = None,
) -> None:
    """Propose a scenario for the robot in an MJCF or URDF: base, limbs, feet, stance, gait and time step.

    Limbs are the rows of two to seven joints that start at one base and end in what is called a foot, or the like. The
    stance is a keyframe's, or searched. Stride, grip and gains are HubRobo's in proportion to mass and reach. Prints
    what was taken from the file, changed and ignored, each with the reason; then the scenario, for you to look through.
    Walks the proposal, and with cycles twice and four times as long, and takes the first with which it holds.

    Beside CONFIG a picture shows the robot by its own shapes, and where its feet are taken to be.

    Exit code 1: it does not walk at any of these; the line says why, and the scenario is there all the same.

    \b
    Examples:
      mjx-climb robot go2.xml
      mjx-climb robot anymal.urdf --write anymal.yaml
      mjx-climb robot humanoid.xml --limbs left_leg,right_leg
      mjx-climb robot limbero.urdf --gravity 1.62
    """
    import mjx_climb as mc
    from mjx_climb import rendering
    from mjx_climb.checks.time_step import largest_time_step
    from mjx_climb.files import dataset
    from mjx_climb.robot.proposal import propose
    from mjx_climb.rollouts.remedies import slow_enough
    from mjx_climb.scenario.model import validated
    from tuning.command_line import progress, report

    if write is not None and write.resolve() == file.resolve():
        raise mc.ConfigError(f"{write}: expected another file than the robot's own")
    proposal = propose(file, gravity, base, limbs.split(",") if limbs else ())
    scenario = validated(mc.Scenario, {**proposal.sections, "time_step": 0.001}, str(file))
    step = min(0.001, largest_time_step(scenario, str(file)))
    scenario = scenario.with_overrides({"time_step": step})
    rows = [*proposal.notes, ("changed", f"time step {step:g} s", "short enough for contacts and joint loop")]
    what = max(len(row[1]) for row in rows)
    for row in rows:
        typer.echo(f"{row[0]:7}  {row[1]:{what}}  {row[2]}")
    with progress.Meter(report.console(stderr=True)).stage("walking it, with slower gaits beside"):
        scenario, walks, how = slow_enough(scenario)
    typer.echo(f"{'taken' if walks else 'failed':7}  {'walk':{what}}  {how}")
    if write is None:
        typer.echo("\n" + scenario.to_yaml(), nl=False)
    else:
        dataset.write_text_atomically(write, scenario.relative_to(write.absolute().parent).to_yaml())
        typer.echo(f"\nwrote {write}: mjx-climb run {write}")
        try:
            picture = rendering.save_image(write.with_suffix(".png"), rendering.stance(scenario.robot))
            typer.echo(f"wrote {picture}: where its feet are")
        except mc.RobotError as error:
            typer.echo(f"no picture: {error}")
        except rendering.RenderingError as error:
            typer.echo(f"no picture: {error}")
    if not walks:
        raise typer.Exit(1)
