"""`mjx-climb run`: one robot through one scenario."""

from pathlib import Path
from typing import Annotated

import typer

from tuning.command_line import options, render_options


def run(
    config: options.Config,
    controller: options.Controller = None,
    hardware: options.Hardware = None,
    changes: options.Set = None,
    gains: options.GainsFile = None,
    law: options.LawFile = None,
    metric: options.Metrics = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder for the results.", show_default="results/<config>-<controller>"),
    ] = None,
    figures: options.Figures = "png",
    json: options.Json = False,
    engine: options.Engine = None,
    compare: render_options.Compare = None,
    video: render_options.Video = False,
    snapshots: render_options.Snapshots = False,
    at: render_options.At = None,
    size: render_options.Size = None,
    view: render_options.View = False,
) -> None:
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
    with options.reserved_stdout() as stdout:
        import mjx_climb as mc
        from mjx_climb import plots
        from mjx_climb.files import dataset, scenario_files
        from mjx_climb.robot.constants import load_robot
        from mjx_climb.rollouts.remedies import remedies
        from tuning.command_line import interruption, progress, report
        from tuning.output.folder import check_own, write_config
        from tuning.report import remarks
        from tuning.report.comparison import gains_of

        scenario, own, table = options.asked(config, controller, changes, hardware, law, metric)
        own, scenario = options.with_gains(own, gains, scenario)
        name = options.law_name(own, scenario)
        engine = options.engine_from(engine)
        formats = options.figures_from(figures)
        load_robot(scenario.robot)
        pictures = render_options.pictures_from(video, snapshots, at, size, view, scenario)
        baseline = render_options.compared(scenario, compare)
        out = out or Path("results") / f"{config.stem}-{name}"
        check_own(out, "trajectory.nc")
        scenario = write_config(scenario, out, own, table)
        baseline = None if baseline is None else scenario_files.copied(baseline, out)

        console = report.console(stderr=True)
        progress.opening(console, scenario)
        meter = progress.Meter(console)
        with meter.stage(name):
            trajectory = mc.rollout(scenario, law=own, engine=engine)
        walks = [trajectory]
        if baseline is not None:
            with meter.stage(baseline.control.controller):
                walks.insert(0, mc.rollout(baseline, engine=engine))
        metrics = mc.metrics(trajectory, table)
        text = report.to_json(metrics)
        dataset.save(dataset.to_dataset(trajectory), out / "trajectory.nc")
        dataset.write_text_atomically(out / "metrics.json", text + "\n")
        with meter.stage("drawing", compiles=False):
            plots.save_figure(plots.plot_walk(trajectory), out / "walk", formats)
            plots.save_figure(plots.plot_feet(trajectory), out / "feet", formats)
        files = ["trajectory.nc", "config.yaml", "metrics.json"]
        files += [f"{name}.{kind}" for name in ("walk", "feet") for kind in formats]
        if baseline is not None:
            names = [baseline.control.controller, name]
            plots.save_figure(plots.plot_comparison(dict(zip(names, walks, strict=True))), out / "comparison", formats)
            files += [f"comparison.{kind}" for kind in formats]
        files += pictures.write(walks, out, meter.stage)

        tables = console if json else report.console(file=stdout)
        if baseline is None:
            tables.print(report.walk_table(metrics, table))
            lines = [report.verdict(trajectory, metrics), *remarks.weightless({name: metrics})]
        else:
            both = [
                (n, walk, mc.metrics(walk, table)) for n, walk in zip(reversed(names), reversed(walks), strict=True)
            ]
            compared = {name: (gains_of(walk), values) for name, walk, values in both}
            tables.print(report.comparison_table(compared, baseline.control.controller, tables.width, table, own))
            lines = [f"{name}: {report.verdict(walk, values)}" for name, walk, values in both]
            lines += remarks.weightless({name: values for name, _, values in both})
        if metrics["detached_limb"] is not None:
            with meter.stage("what would help", compiles=False):
                lines.append(remedies(scenario, float(metrics["detached_at"] or 0.0), own))
        for line in lines:
            tables.print(line, soft_wrap=True)
        console.print(f"written to {out}: {', '.join(files)}", soft_wrap=True)
        if json:
            print(text, file=stdout)
        if view:
            from mjx_climb import rendering

            rendering.view(*walks, until=interruption.requested)
        if metrics["diverged"] or metrics["detached_limb"] is not None:
            raise typer.Exit(1)
