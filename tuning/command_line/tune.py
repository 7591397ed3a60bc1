"""`mjx-climb tune`: a search for gains."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_climb.scenario import shipped
from tuning.command_line import processes
from tuning.command_line.ending import InputError, Interrupted, kept_in
from tuning.command_line.from_models import command
from tuning.command_line.options import ENSEMBLE, Output, SearchFile, Walk
from tuning.command_line.typed import origin, repeated
from tuning.problem.search import ROBUST_WEIGHTS, Search
from tuning.problem.settings import Options, setting

if TYPE_CHECKING:
    from tuning.problem.ensemble import Ensemble


class Many(Options):
    """The ensemble that gains are searched for."""

    ensemble: Path | None = setting(None, f"tune for {ENSEMBLE}", metavar="FILE", complete="ensemble")
    members: int | None = setting(None, "walks of the ensemble; null: the file's", ge=1)
    judges: int | None = setting(None, "walks of the fresh draw; null: 128", ge=1)

    def load(self) -> "Ensemble | None":
        """Return the ensemble, None without one.

        Raises:
            ConfigError, InputError: no ensemble, or options for one.
        """
        from tuning.problem.ensemble import Ensemble

        if self.ensemble is None:
            for name in self.model_fields_set:
                raise InputError(f"--{name}: expected --ensemble with it")
            return None
        return Ensemble.load(shipped.found(self.ensemble), **self.model_dump(include={"members"}, exclude_unset=True))


def tune(search: Search, file: SearchFile, ensemble: Many, walk: Walk, output: Output) -> None:
    """Search the gains of the controller, from the config's own gains and from random ones side by side.

    Minimises force variation, peak foot force and cost of transport, each relative to pd, while the grippers hold,
    the joints keep their limits, the base stays within three times pd's deviation, and nothing gets worse than under
    pd. With hardware in the loop kp and kd are searched too. Then walks the result in double precision, tests it, and
    compares it with the config's gains, pd, and pd with kp and kd searched for the same: what no force sensor gives.

    Writes to DIR the gains (gains.yaml, for run and sweep), everything judged (search.nc), the settings (config.yaml,
    search.yaml), the summary (summary.json), the map and the pictures (map.nc, convergence, path, walks, margins), and
    all of it to look through in a browser (report.html). Finished rounds are kept: after Ctrl-C, which ends with the
    best so far, or worse, the same command goes on.

    With --ensemble every set of gains walks through all members (pushes, cargo, slope, grip stiffness, robot mass drawn
    from a seed, and hardware where the file says so), mean and worst count, the peak pulling force with them, and a
    fresh draw judges the result, and says how many of its walks break each limit.

    \b
    METRIC: force_variation, peak_foot_force, peak_pull_force (N), peak_joint_torque (N m),
      cost_of_transport, travel, base_deviation, min_tsm (m), min_gia_margin (m/s^2),
      joint_limit_margin (rad); with --metric the user's own
    GAIN: damping, damping.translation, damping.rotation, damping.x .. damping.rz;
      stiffness and inertia likewise; kp, kd; with --law the law's own gains

    \b
    Examples:
      mjx-climb tune case_1_2
      mjx-climb tune case_2 --method gradient --space diagonal --limit base_deviation=0.015
      mjx-climb tune case_1_1 --method cmaes --space split --pin damping.rotation=50
      mjx-climb tune case_2 --ensemble ensemble --members 16
    """
    with processes.joined() as team, output.session() as shell:
        from tuning.background import background
        from tuning.output import comparisons, folder
        from tuning.searches import tune as searches

        loaded, drawn = walk.load_with_gains(), ensemble.load()
        if drawn is not None and "weights" not in search.model_fields_set and file.search is None:
            search = search.model_copy(update={"weights": ROBUST_WEIGHTS})
        wanted = file.settings(search, loaded, walk.config)
        if drawn is not None:
            wanted = searches.over_ensemble(wanted, {}, drawn)
        chosen = search.method if "method" in search.model_fields_set else None
        wanted = searches.for_this_machine(loaded.scenario, wanted, (file.search, chosen), walk.engine, loaded.law)
        kind = "tune" if drawn is None else "robust"
        out = team.folder(output.folder(walk.config.stem, kind, wanted.method, wanted.space))
        folder.check_own(out, "search.nc")
        shell.opening(loaded.scenario)
        shell.say(*filter(None, [team.said]))
        team.begin(out, loaded.scenario)
        with shell.stage("baseline"), file.naming(search):
            problem = searches.problem_of(loaded.scenario, wanted, ensemble=drawn, **loaded.how)
        with kept_in(out, "rounds") as kept, background(busy=1) as begin:
            begin(lambda _: folder.writer(kind))  # matplotlib takes half a second
            compared = None
            if drawn is None:
                comparisons.load_tests(problem, wanted, begin)
                compared = comparisons.of_search(problem, wanted, begin, out=out)
            with shell.stage("search", unit="rounds") as show:
                found: Any = searches.run(problem, wanted, out=out, progress=kept.rounds(show))
            if ensemble.judges is not None:
                found = dataclasses.replace(found, judges=ensemble.judges)
            files = ["search.yaml"] if drawn is None else ["search.yaml", "--ensemble", "ensemble.yaml"]
            again = repeated(["tune", "--search", *files], "--engine")
            made = origin(walk.config.stem, again)
            if found.interrupted:
                found.write_found(out, made)
                raise Interrupted(
                    f"the best of {kept.done} rounds is in {out}: objective {found.value:.4f}, gains.yaml; "
                    "the same command goes on from there"
                )
            written = found.write(out, origin=made, figures=output.figures, stage=shell.stage, compared=compared)
        shell.result(out, problem, written, gains=True)


COMMAND = command(tune, "results/<config>-tune-<method>-<space>")
