"""`mjx-climb excite`: what to command to a robot whose parameters are to be identified."""

from typing import Annotated

from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk
from tuning.command_line.program import origin, repeated
from tuning.problem.excitation import Excitation


@command("results/<config>-excite")
def excite(walk: Annotated[Walk, "config", "hardware", "changes"], asked: Excitation, output: Output) -> None:
    """Find what to command so that the robot's own log tells its parameters.

    Candidates are scaled, stretch by stretch, until joint limits, torque, speed and reach (free: pull of the grippers)
    hold with a margin in the nominal model; the one whose log has the most Fisher information is taken. Prints the
    standard deviations to expect, beside those after a plain chirp, and what the log will not be able to tell apart.

    Writes to DIR the commands (excitation.csv: time, and LF.coxa.command ... in rad; excitation_trajectory.yaml, a
    trajectory_msgs/JointTrajectory), what is expected (excitation.json, report.html) and a picture (excitation).

    \b
    Examples:
      mjx-climb excite case_1_1 --hardware dynamixel_x
      mjx-climb excite case_1_1 --fit hardware.servo.armature --family multisine
      mjx-climb excite case_1_1 --hardware dynamixel_x --kp 25 --kp 50 --mass 0.1 --drop
      mjx-climb excite case_1_1 --base free --fit contact.stiffness --fit contact.damping --json
    """
    with output.session() as shell:
        from tuning.command_line.session import from_page
        from tuning.identification import excitation
        from tuning.output import excitation as written
        from tuning.report.numbers import to_json

        rig = excitation.set_up(walk.load().scenario, asked)
        shell.claim(written.FILE, walk.config.stem, "excite")
        shell.opening()
        found = excitation.chosen(rig, stage=shell.stage)
        options = (f"--{name.replace('_', '-')}" for name in Excitation.model_fields)
        where = origin(walk.config.stem, repeated(("excite",), *options))
        files = found.write(shell.out, figures=output.figures, stage=shell.stage, origin=where)
        shell.show(from_page(written.table(found)), from_page(written.limits(found)))
        shell.show(*written.notes(found), found.best.information.unseen())
        shell.written(files, to_json(written.summary(found)))
