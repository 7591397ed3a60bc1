"""`mjx-climb identify`: the parameters of a scenario from a robot's own log."""

import json
from pathlib import Path
from typing import Annotated

from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk
from tuning.problem.settings import Options, setting


class Asked(Options):
    """What is fitted, to which log."""

    log: Path = setting(..., "log: MCAP, rosbag, CSV or netCDF", metavar="FILE")
    fit: tuple[str, ...] = setting(..., "key that is fitted, or a pattern of keys, as hardware.servo.*", metavar="KEY")
    signals: Path | None = setting(
        None, "where each signal stands in the log, YAML; null: by its own names, or guessed", metavar="FILE"
    )
    held_out: float = setting(0.2, "share of the log, at its end, that is predicted and not fitted", ge=0, le=0.8)
    starts: int = setting(4, "points from which the search begins, the config's own among them", ge=1, le=64)


@command("none: nothing is written")
def identify(asked: Asked, walk: Annotated[Walk, "config", "hardware", "changes"], output: Output) -> None:
    """Fit parameters of a scenario to what the robot itself recorded on a stand, its base held.

    The log holds the commands of the joints and what came of them, as excite asks for. KEY is one of a scenario's
    (hardware.servo.armature, hardware.command_delay, control.kp), gravity (its direction), or one of the robot's own:
    robot.LF.coxa.armature, friction, damping, zero; robot.LF.coxa.mass, center, inertia.

    Prints what was known before and is now, with 95 % intervals, what the log does not tell, and whether the model is
    right. With --out writes to DIR the scenario as identified (identified.yaml, hardware.yaml for --hardware, and a
    robot's file where it was fitted), an ensemble of what is left open (posterior.yaml, for tune and judge), all
    numbers (result.json), pictures, and a page (report.html).

    \b
    Examples:
      mjx-climb identify case_1_2 --log log.csv --fit hardware.servo.armature --fit control.kp
      mjx-climb identify case_1_2 --log log.mcap --fit hardware.command_delay --signals signals.yaml
      mjx-climb identify case_1_2 --log log.csv --fit "robot.*.armature" --out found --json
    """
    with output.session() as shell:
        from mjx_climb.files.dataset import check_folder
        from tuning.command_line.program import origin, repeated
        from tuning.command_line.session import from_page
        from tuning.identification import identify as fitting
        from tuning.identification.output import table

        if output.out is not None:
            check_folder(output.out)
        scenario = walk.load().scenario
        with shell.stage("fit", unit="iterations") as show:
            found = fitting.identify(
                scenario, asked.log, asked.fit, signals=asked.signals, held_out=asked.held_out, starts=asked.starts,
                progress=show,
            )  # fmt: skip
        shell.show(from_page(table(found)), *(f"warning: {line}" for line in found.warnings), *found.combined)
        shell.show(f"{found.sentence}.")
        if output.out is not None:
            again = repeated(["identify"], "--log", "--fit", "--signals")
            with shell.stage("writing", compiles=False):
                files = found.write(output.out, origin=origin(walk.config.stem, again), figures=output.figures)
            shell.out = output.out
            shell.written(", ".join(files), json.dumps(found.as_json(), indent=2))
        else:
            shell.print_json(json.dumps(found.as_json(), indent=2))
