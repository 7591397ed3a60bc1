"""`mjx-climb run`: one robot through one scenario."""

import typer

from tuning.command_line import interruption
from tuning.command_line.from_models import command
from tuning.command_line.options import Output, Walk
from tuning.command_line.render_options import Pictures


def run(walk: Walk, output: Output, pictures: Pictures) -> None:
    """Walk one robot through a scenario, in double precision.

    Prints the metrics with their units and whether the grippers held, and writes to DIR the full time histories
    (trajectory.nc, opens with xarray), the resolved scenario (config.yaml), the metrics (metrics.json), pictures
    over time (walk) and of the feet's paths on the ground (feet), with --compare the plots of both walks (comparison);
    each picture in the formats of --figures.

    In videos and snapshots the force on a foot is an arrow: light blue where the ground presses, yellow to red as a
    pull nears the holding limit. They need OpenGL (EGL or OSMesa), not a display.

    Exit code 1: the robot lost a gripper, or the walk diverged; all is written, and the line says what failed first.

    \b
    Examples:
      mjx-climb run case_2
      mjx-climb run case_1_2 --controller pd --json
      mjx-climb run case_1_2 --set control.damping=2e3 --set disturbance.cargo.mass=0.5
      mjx-climb run case_2 --video --compare pd
      mjx-climb run case_2 --law my_law.py:Filtered --gains best.yaml
      mjx-climb run case_1_2 --snapshots --at 2.5,4.6
    """
    with output.session() as shell:
        import mjx_climb as mc
        from mjx_climb.files import dataset, scenario_files
        from mjx_climb.robot.constants import load_robot
        from mjx_climb.rollouts.remedies import remedies
        from tuning.command_line import report
        from tuning.output.folder import check_own, write_config
        from tuning.report import remarks
        from tuning.report.comparison import gains_of
        from tuning.report.numbers import to_json

        scenario, law, table, _ = walk.load_with_gains()
        name = scenario.control.controller if law is None else type(law).__name__
        load_robot(scenario.robot)
        pictures.check(scenario)
        out = output.folder(walk.config.stem, name)
        check_own(out, "trajectory.nc")
        rival = pictures.compared(scenario)
        scenario = write_config(scenario, out, law, table)

        shell.opening(scenario)
        with shell.stage(name):
            trajectory = mc.rollout(scenario, law=law, engine=walk.engine)
        walks = {name: trajectory}
        if rival is not None:
            rival = scenario_files.copied(rival, out)
            with shell.stage(rival.control.controller):
                walks = {rival.control.controller: mc.rollout(rival, engine=walk.engine), **walks}
        metrics = {name: mc.metrics(walked, table) for name, walked in reversed(walks.items())}
        text = to_json(metrics[name])
        dataset.save(dataset.to_dataset(trajectory), out / "trajectory.nc")
        dataset.write_text_atomically(out / "metrics.json", text + "\n")
        with shell.stage("drawing", compiles=False):
            from mjx_climb import plots  # matplotlib takes a third of a second

            figures = {"walk": plots.plot_walk(trajectory), "feet": plots.plot_feet(trajectory)}
            figures |= {} if rival is None else {"comparison": plots.plot_comparison(walks)}
            for stem, figure in figures.items():
                plots.save_figure(figure, out / stem, output.figures)
        files = ["trajectory.nc", "config.yaml", "metrics.json"]
        files += [f"{stem}.{kind}" for stem in figures for kind in output.figures]
        files += pictures.write(walks, out, shell.stage)

        verdicts = {name: report.verdict(walks[name], values) for name, values in metrics.items()}
        if rival is None:
            shell.show(report.walk_table(metrics[name], table), *verdicts.values())
        else:
            compared = {name: (gains_of(walks[name]), values) for name, values in metrics.items()}
            shell.show(report.comparison_table(compared, rival.control.controller, shell.tables.width, table, law))
            shell.show(*(f"{name}: {verdict}" for name, verdict in verdicts.items()))
        shell.show(*remarks.weightless(metrics))
        lost = metrics[name]["detached_limb"] is not None
        if lost:
            with shell.stage("what would help", compiles=False):
                shell.show(remedies(scenario, float(metrics[name]["detached_at"] or 0.0), law))
        shell.written(out, ", ".join(files), text)
        if pictures.view:
            from mjx_climb import rendering

            rendering.view(*walks.values(), until=interruption.requested)
        if lost or metrics[name]["diverged"]:
            raise typer.Exit(1)


COMMAND = command(run, "results/<config>-<controller>")
