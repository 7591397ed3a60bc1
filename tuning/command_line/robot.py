"""`mjx-climb robot`: a scenario for a robot's own file."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from pydantic import BeforeValidator

import mjx_climb as mc
from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import ROOF, SLOPE, inclined
from tuning.command_line.program import InputError
from tuning.problem.settings import Options, setting


class Robot(Options):
    """The proposal and its robot."""

    file: Path = setting(..., "MJCF (.xml) or URDF (.urdf) of the robot", metavar="FILE", argument=True)
    write: Path | None = setting(None, "scenario to write, ready for run; null: print it", metavar="CONFIG")
    gravity: float = setting(9.81, "strength of gravity, m/s^2; on the Moon 1.62", metavar="M/S2")
    slope: float | None = SLOPE
    roof: bool = ROOF
    base: str | None = setting(None, "body that the limbs begin at; null: found", metavar="BODY")
    limbs: Annotated[tuple[str, ...], BeforeValidator(lambda text: text.split(","))] = setting(
        (), "limbs to stand on; others are held; null: all", metavar="NAME,NAME,..."
    )
    stand: bool = setting(False, "the base is held on a stand, as a bench's: no feet, and no walk")

    def strength(self) -> float:
        """Return the strength of gravity, m/s^2, refused where it has a sign."""
        if self.gravity < 0:
            raise InputError(
                f"--gravity: expected its strength, 0 or more, got {self.gravity:g}; --roof turns it round"
            )
        return self.gravity

    def lies(self) -> str:
        """Return how the ground lies, in words."""
        if self.slope is None and not self.roof:
            return "on level ground; --gravity, --slope and --roof take another"
        return "on a roof" if self.roof else f"on a slope of {self.slope:g} degrees"


@command("How does my robot become a scenario?")
def robot(asked: Robot) -> None:
    """Propose a scenario for the robot in an MJCF or URDF: base, limbs, feet, stance, gait and time step.

    Limbs are the rows of two to seven joints that start at one base and end in a foot, by its name. The stance is a
    keyframe's, or searched. Stride, grip and gains are HubRobo's in proportion to mass and reach. Prints parts of the
    file that were taken, changed and ignored, each with the reason; then the scenario, for you to look through. Walks
    the proposal: under pd with 45 pairs of kp and kd, or 15 where time steps are short, to take that of least force
    variation; with cycles twice and four times as long, to take the first with which it holds; on a ceiling, to say the
    holding limit that it takes.

    Beside CONFIG a picture shows the robot by its own shapes, and where its feet are taken to be.

    With --stand each row of joints is a limb of a held base, as for excite, replay and identify: a servo with a weight
    on a rod is one.

    Exit code 1: it does not walk at any of these; the line says why, and the scenario is there all the same.

    \b
    Examples:
      mjx-climb robot go2.xml
      mjx-climb robot anymal.urdf --write anymal.yaml
      mjx-climb robot humanoid.xml --limbs left_leg,right_leg
      mjx-climb robot limbero.urdf --gravity 1.62 --slope 30
      mjx-climb robot pendulum.xml --stand --write bench.yaml
    """
    file, write = asked.file, asked.write
    if write is not None and write.resolve() == file.resolve():
        raise mc.ConfigError(write, "", "another file than the robot's own")
    if asked.stand:
        _write_stand(asked)
        return
    with interruption.at_once():
        scenario, walks = _walked(asked)
    _put(scenario, write, mc.Scenario.to_yaml, "run {}")
    if write is not None:
        from mjx_climb.viz import rendering

        try:
            picture = rendering.save_image(write.with_suffix(".png"), rendering.stance(scenario.robot))
            typer.echo(f"wrote {picture}: where its feet are")
        except (mc.RobotError, rendering.RenderingError) as error:
            typer.echo(f"no picture: {error}")
    if not walks:
        raise typer.Exit(1)


def _walked(asked: Robot) -> tuple[mc.Scenario, bool]:
    """Return a scenario for a robot, and whether it walks; print how both came about."""
    from mjx_climb.inputs.time_step import largest_time_step
    from mjx_climb.scenario.model import validated
    from tuning.command_line.session import Session, duration
    from tuning.comparisons import first_walks
    from tuning.proposal.propose import propose

    gravity = inclined((0.0, 0.0, -asked.strength()), asked.slope, asked.roof)
    proposal = propose(asked.file, asked.gravity, asked.base, asked.limbs)
    scenario = validated(mc.Scenario, {**proposal.sections, "gravity": gravity, "time_step": 0.001}, str(asked.file))
    step = min(0.001, largest_time_step(scenario, str(asked.file)))
    scenario = scenario.with_overrides({"time_step": step})
    rows = [
        *proposal.notes,
        ("taken", f"gravity {asked.strength():g} m/s^2", asked.lies()),
        ("changed", f"time step {step:g} s", "short enough for contacts and joint loop"),
    ]
    what = max(len(row[1]) for row in rows)
    for row in rows:
        typer.echo(f"{row[0]:7}  {row[1]:{what}}  {row[2]}")

    def tell(kind: str, name: str, why: str) -> None:
        typer.echo(f"{kind:7}  {name:{what}}  {why}")

    done = 0

    def told(walks: int) -> None:
        nonlocal done
        done += walks
        show(done, max(done, total))

    session, (total, seconds) = Session(sys.stdout), first_walks.expected(scenario)
    steps = f"{scenario.duration / scenario.time_step:,.0f} time steps"
    session.say(f"{total} walks of {steps}: about {duration(seconds)} on one core, once compiled")
    with session.stage("walking it, with other joint gains and slower gaits beside") as show:
        scenario, searched = first_walks.with_joint_gains(scenario, told)
        scenario, walks, how, load, hung = first_walks.slow_enough(scenario, told)
        ceiling = first_walks.on_ceiling(scenario, told, hung) if walks and any(gravity) and not asked.roof else None
    tell("changed", f"kp {scenario.control.kp:g}, kd {scenario.control.kd:g}", searched)
    tell("taken" if walks else "failed", "walk", how)
    if heavy := first_walks.heavy_load(scenario, load):
        tell("warning", "load", heavy)
    if ceiling:
        tell("taken" if ceiling[0] else "warning", "ceiling", ceiling[1])
    return scenario, walks


def _write_stand(asked: Robot) -> None:
    """Write, or print, the scenario of a robot on a stand."""
    import yaml

    from mjx_climb.robot_import.load import load_robot
    from mjx_climb.scenario.model import validated
    from tuning.proposal.stand import on_stand

    if asked.limbs:
        raise InputError(f"--limbs: expected none with --stand, got {','.join(asked.limbs)}")
    gravity = inclined((0.0, 0.0, -asked.strength()), asked.slope, asked.roof)
    scenario = validated(mc.Scenario, {"robot": on_stand(asked.file, asked.base), "gravity": gravity}, str(asked.file))
    for limb, joints in load_robot(scenario.robot).joints_in_file:
        typer.echo(f"taken    {limb}  {', '.join(joints)}")

    def text(scenario: mc.Scenario) -> str:
        return yaml.safe_dump(scenario.model_dump(mode="json", exclude_defaults=True), sort_keys=False)

    _put(scenario, asked.write, text, "identify {} --log LOG --fit KEY")


def _put(scenario: mc.Scenario, file: Path | None, text: Callable[[mc.Scenario], str], then: str) -> None:
    """Write a scenario into a file and say the command that takes it, or print it where there is none."""
    from mjx_climb.files import dataset

    if file is None:
        typer.echo("\n" + text(scenario), nl=False)
    else:
        dataset.write_text_atomically(file, text(scenario.relative_to(file.absolute().parent)))
        typer.echo(f"\nwrote {file}: mjx-climb {then.format(file)}")
