"""`mjx-climb evaluate`: gains where no search looked: on unseen walks, and on worse hardware."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjx_climb.scenario import shipped
from tuning.command_line.from_models import command, in_options
from tuning.command_line.options import ENSEMBLE, SHARD, Members, Output, Walk
from tuning.command_line.program import InputError, repeated
from tuning.command_line.sweep import merge, walk_rows
from tuning.problem.ceiling import Ceiling
from tuning.problem.search import Judge, Search, check_metrics
from tuning.problem.settings import Options, Positive, setting

if TYPE_CHECKING:
    from tuning.comparisons.degraded import Worse as Worsened
    from tuning.comparisons.judge import Draw
    from tuning.comparisons.pushes import Walker
    from tuning.gains.gains_file import Whole
    from tuning.problem.ensemble import Ensemble
    from tuning.problem.evaluation import Problem


class Rival(Options):
    """The rival of gains."""

    retuned_pd: Path | None = setting(
        None, "gains file whose kp and kd (and gait) pd walks with too, beside pd as the config has it", metavar="FILE"
    )

    def joint_gains(self) -> dict[str, float]:
        """Return kp and kd of the file, and its gait where it has one; none without a file."""
        from tuning.gains import gains_file

        if self.retuned_pd is None:
            return {}
        from mjx_climb.inputs.gait_values import GAIT

        values = gains_file.by_name(gains_file.load(self.retuned_pd))
        if missing := [name for name in ("kp", "kd") if name not in values]:
            expected = f"a gains file with kp and kd, {self.retuned_pd} has no {' and no '.join(missing)}"
            raise InputError(f"--retuned-pd: expected {expected}")
        return {name: value for name, value in values.items() if name in ("kp", "kd", *GAIT)}


class Margins(Rival):
    """How bad hardware may be."""

    margins: bool = setting(
        False, "find how late, slow and weak hardware may be before the gains of one file, or the config's, fail"
    )
    margin: tuple[str, ...] = setting(
        (),
        "with --margins: a path that gets worse up to a value, as contact.spread=0.8, or by a factor, as "
        "contact.damping=x0.1, in place of delays, period and joint gains",
        metavar="PATH=VALUE",
    )


def margins(asked: Margins, walk: Annotated[Walk, "-metrics"], output: Annotated[Output, "-sections"]) -> None:
    """Find how late, slow and weak a robot's hardware may be before gains fail."""
    with output.session(walks=True) as shell:
        from mjx_climb.control import PD, law_of
        from mjx_climb.scenario.messages import ConfigError
        from tuning.comparisons import linear_margins
        from tuning.comparisons import margins as evaluation
        from tuning.gains.gains_file import Whole, apart, by_name
        from tuning.pages import margins as pages
        from tuning.results.config_file import write_config

        loaded = walk.load()
        law = loaded.law
        try:
            quantities = evaluation.quantities(loaded.scenario, asked.margin) or evaluation.QUANTITIES
        except ConfigError as error:
            raise error.moved(source="--margin") from None
        gains, others = walk.values(law) or {}, {}
        known: dict[str, Any] = {"gains": by_name(gains)} | ({"of": list(asked.margin)} if asked.margin else {})
        if walk.gains is not None and law is None:
            config = walk.model_copy(update={"gains": None}).load().scenario
            known["config"] = config.control.model_dump(mode="json")
            others["config"] = Whole(None if config == loaded.scenario else law_of(config), {})
        if joint := asked.joint_gains():
            others[evaluation.RETUNED] = Whole(PD(), joint)
        walk.take(shell, "margins.json", loaded, "margins", **known, retuned_pd=joint)
        how: dict[str, Any] = {"law": law, "asked": quantities, "engine": walk.engine}
        with shell.whole() as out:
            scenario = write_config(loaded.scenario, out, law)
            shell.opening(scenario)
            with shell.stage("margins") as told:
                found = evaluation.find(scenario, gains, others=others, progress=told, **how)
            with shell.stage("linearised loop", unit="quantities") as told:
                place, own = apart(scenario, gains)
                stable = linear_margins.find(place, own, found.margins, progress=told, **how)
            warnings = evaluation.warnings(found) + linear_margins.warnings(found.margins, stable)
            files = pages.files(found, stable, warnings, "config" if walk.gains is None else walk.gains.stem)
            shell.show(pages.margins_table(found, stable), *(f"warning: {line}" for line in warnings))
            names = shell.fill(out, files)
        shell.written(names, files["margins.json"])


class Files(Rival):
    """Gains that are compared."""

    gains: tuple[Path, ...] = setting((), "gains file to evaluate", metavar="FILE")

    def named(self, loaded: "Problem") -> "dict[str, Whole]":
        """Return the gains of the files, each with its law, by the names of the files, and retuned pd."""
        from mjx_climb.control import PD
        from tuning.gains import gains_file
        from tuning.searches.retuned_pd import NAME

        if (
            loaded.law is None
            and loaded.scenario.control.controller == "pd"
            and not all(map(gains_file.shipped_law, self.gains))
        ):
            raise InputError("--controller: expected a law whose gains are evaluated, got pd, which walks beside them")
        named = {file.stem: gains_file.whole(file, loaded.scenario, loaded.law) for file in self.gains}
        if len(named) < len(self.gains) or named.keys() & {"config", "pd", NAME}:
            got = ", ".join(file.stem for file in self.gains)
            raise InputError(f"--gains: expected files of different names, none config, pd or {NAME}, got {got}")
        if joint := self.joint_gains():
            named[NAME] = gains_file.Whole(PD(), joint)
        return named


class Rivals(Files, Judge):
    """The gains that are evaluated, and their walks."""

    gains: tuple[Path, ...] = setting(..., "gains file to evaluate", metavar="FILE")
    ensemble: Path = setting(Path("ensemble"), ENSEMBLE, metavar="FILE", complete="ensemble")
    shard: str | None = SHARD

    def work(self, walk: Walk) -> "Draw":
        """Return the walks of the gains."""
        from tuning.comparisons.judge import draw_of

        return draw_of(*self.asked(walk), self.members)

    def asked(self, walk: Walk) -> "tuple[Problem, dict[str, Whole], Ensemble]":
        """Return the walk, the gains by name and the ensemble."""
        from tuning.problem.ensemble import Ensemble

        loaded = walk.load()
        return loaded, self.named(loaded), Ensemble.load(shipped.found(self.ensemble))

    def said(self, work: Any, here: int, _: int) -> list[str]:
        """Return how many walks there are."""
        return [f"{here} members, {len(work.gains) + 1} walks of {work.problem.scenario.steps} steps each"]


class Worse(Rivals):
    """The worse hardware on which gains are evaluated."""

    worse: tuple[str, ...] = setting(
        (),
        "walk on worse hardware too: a factor, as delay=x2, a key of the section hardware, as servo.backlash=0.01, "
        "or a path",
        metavar="KEY=VALUE",
    )

    def work(self, walk: Walk) -> "Worsened":
        """Return the walks of the gains in all settings."""
        from mjx_climb.scenario.messages import ConfigError
        from tuning.comparisons.degraded import draw_of

        asked = self.asked(walk)
        try:
            return draw_of(*asked, self.worse, self.members)
        except ConfigError as error:
            words = {name: getattr(error, name).removeprefix("worse").removeprefix(": ") for name in ("key", "reason")}
            raise error.moved(source="--worse", **words) from None
        except ValueError as error:
            raise InputError(f"--worse: {error}") from None

    def said(self, work: Any, here: int, _: int) -> list[str]:
        """Return how many walks there are."""
        each = f"{self.members} members of {work.problem.scenario.steps} steps each"
        return [f"{len(work.settings)} settings, {len(work.gains) + 1} walks of {each}"]


def worse(asked: Annotated[Worse, "-shard"], walk: Annotated[Walk, "-gains"], output: Output) -> None:
    """Walk gains through unseen members as drawn, and on worse hardware, one thing at a time."""
    files = ["evaluate", "--ensemble", "ensemble.yaml"]
    again = repeated(files, "--gains", "--retuned-pd", "--worse", "--members", "--engine")
    walk_rows(asked, walk, output, "degrade", again)


class Bounds(Files, Members):
    """A bound of every law."""

    ceiling: bool = setting(
        False, "find how good any law could be on these walks, and what a force sensor is worth at most"
    )

    def load(self) -> "Ensemble | None":
        """Return the ensemble, the shipped one where members alone are asked for, None without either."""
        return self.loaded(self.ensemble or Path("ensemble")) if self.ensemble or self.members else None


class Pushes(Files):
    """How large a push walks bear."""

    pushes: bool = setting(False, "find the largest pushes on the base that half and 95 % of the walks survive")
    push_length: tuple[Positive, ...] = setting(
        (0.2, 1.0), "length of a push, s", metavar="S", default_in_words="0.2 and 1"
    )
    largest_push: Positive = setting(60.0, "largest force that is tried, N; the smallest is a 64th")
    push_draws: int = setting(80, "instants, and seeds of noise, that are drawn for each direction", ge=8)

    def walkers(self, loaded: "Problem") -> "dict[str, Walker]":
        """Return the gains of the files, the config's law and pd; without recovery too where the config has one."""
        from mjx_climb.control import PD, law_of
        from mjx_climb.inputs.from_scenario import own_parameters
        from tuning.comparisons.pushes import Walker

        scenario, own = loaded.scenario, own_parameters(loaded.scenario)
        each = {name: Walker(whole.law, whole.gains, own) for name, whole in self.named(loaded).items()}
        if loaded.law is not None or scenario.control.controller != "pd":
            each["config"] = Walker(loaded.law or law_of(scenario), {}, own)
        each["pd"] = Walker(PD(), {}, own)
        if own.recovery is None:
            return each
        bare = dataclasses.replace(own, recovery=None)
        return {
            f"{name}{words}": walker._replace(parameters=parameters)
            for name, walker in each.items()
            for words, parameters in (("", own), (", no recovery", bare))
        }


def pushes(asked: Pushes, walk: Annotated[Walk, "-gains", "-metrics"], output: Annotated[Output, "-sections"]) -> None:
    """Find the largest pushes that walks survive, by direction and length."""
    with output.session(walks=True) as shell:
        from tuning.comparisons import pushes as search
        from tuning.gains.gains_file import by_name
        from tuning.pages import pushes as pages
        from tuning.results.config_file import write_config

        loaded = walk.load()
        walkers = asked.walkers(loaded)
        how: dict[str, Any] = {"lengths": asked.push_length, "largest": asked.largest_push, "draws": asked.push_draws}
        known = {name: {"law": repr(each.law), "gains": by_name(each.gains)} for name, each in walkers.items()}
        walk.take(shell, "pushes.json", loaded, "pushes", gains=known, **how)
        with shell.whole() as out:
            scenario = write_config(loaded.scenario, out, loaded.law)
            shell.opening(scenario)
            with shell.stage("pushes") as told:
                found = search.find(scenario, walkers, **how, engine=walk.engine, progress=told)
            again = repeated(["evaluate", "--pushes"], "--gains", "--retuned-pd", "--push-length", "--largest-push",
                             "--push-draws", "--engine")  # fmt: skip
            files, page = pages.files(found), pages.page_of(found, scenario)
            shell.show(*page.tables, page.findings.verdict)
            names = shell.fill(out, files, page.at, again)
        shell.written(names, files["pushes.json"])


# of the settings those that a first search needs
_Asked = Annotated[
    Ceiling, "weights", "limits", "better", "against", "points", "knots", "delays", "iterations", "test_members"
]


def ceiling(asked: Bounds, search: _Asked, walk: Annotated[Walk, "-gains"], output: Output) -> None:
    """Find the best joint targets over time, by their knowledge, beside pd and the laws of gains files."""
    with output.session(walks=True) as shell:
        from mjx_climb.control import law_of
        from mjx_climb.scenario.messages import ConfigError
        from tuning.gains.gains_file import Whole, by_name
        from tuning.searches import ceiling as bounds

        loaded = walk.load()
        check_metrics(Search(weights=search.weights, limits=search.limits), loaded.metrics, "--weight, --limit")
        laws, ensemble = asked.named(loaded), asked.load()
        if loaded.law is not None or loaded.scenario.control.controller != "pd":
            laws["config"] = Whole(loaded.law or law_of(loaded.scenario), {})
        known = {name: {"law": repr(each.law), "gains": by_name(each.gains)} for name, each in laws.items()}
        walked = dataclasses.replace(loaded, ensemble=ensemble)
        walk.take(shell, "ceiling.nc", walked, "ceiling", search=search, gains=known)
        shell.opening(loaded.scenario)
        with shell.stage("ceiling", unit="gradients") as told:

            def shown(name: str, done: int, of: int) -> None:
                told(done, of, f"{name}: {done} of {of} gradients")

            try:
                found = bounds.ceiling(
                    loaded.scenario, laws, search, ensemble=ensemble, metrics=loaded.metrics, engine=loaded.engine,
                    progress=shown,
                )  # fmt: skip
            except ConfigError as error:
                raise error.moved(key=in_options(error.key, Ceiling)) from None
        again = ["evaluate", "--ceiling", *(["--ensemble", "ensemble.yaml"] if ensemble is not None else [])]
        shell.result(found, repeated(again, "--gains", "--retuned-pd", "--weight", "--limit", "--better",
                                     "--against", "--points", "--knots", "--delays", "--iterations",
                                     "--test-members", "--engine"))  # fmt: skip


@command(
    "Do gains hold where no search looked?",
    "results/<config>-evaluate, -margins, -worse, -ceiling or -pushes",
    {"margins": margins, "worse": worse, "ceiling": ceiling, "pushes": pushes, "merge": merge},
)
def evaluate(rivals: Rivals, walk: Annotated[Walk, "-gains"], output: Output) -> None:
    """Walk gains through a draw that no search over the ensemble has seen, beside the config's own and pd.

    As tune --ensemble tests its result: pushes, cargo, slope, grips, masses and hardware are drawn with another seed,
    nothing is torn off, and a walk fails where it pulls beyond the holding limit. A file that names its law or gait
    walks with these. Prints mean and worst 5 % of each metric; writes to DIR every walk (judged.nc), a picture, the
    summary and a page. `mjx-climb plot DIR` draws other metrics. --json has the differences from pd, or from that of
    --retuned-pd, with 95 % intervals.

    A force sensor that dies is a key of the config: --set hardware.force_sensor.dead.LF=3.0, as worse hardware is.

    --margins makes force delay, command delay, control period and joint gains worse, one at a time, on top of the
    scenario's own hardware, and says up to where no gripper is torn off, up to where the force varies less than under
    pd (that of --retuned-pd, where it is given) on the same hardware, and up to where the linearised loop is stable.
    Warns where walks, or the linearised loop, bear less than twice the hardware's own. DIR has the margins
    (margins.json), all walks (margins.nc) and the force variation over each quantity (margins, in the formats of
    --figures). --margin makes other values worse in their place, those of your own components too.

    --worse walks the same members on worse hardware too, one --worse at a time: with a factor on delay, period,
    friction, backlash, noise, bias or armature, as the config has it or a member drew it, or with other values of keys
    of the config's section hardware, as force_sensor.dead.LF=3.0 for a sensor that dies at 3 s, or with a value or
    factor at any path, as contact.damping=x0.5. Prints the loss of each
    of the gains, and their lead over the best rival of the first gains as drawn. DIR has every walk (degraded.nc).

    --ceiling finds how good any law could be: the best joint targets over time for each walk, known in advance; the
    same plan for all walks, which needs no sensor; plans that know of a disturbance from a delay after its begin. The
    walk is the config's own; with --ensemble or --members an ensemble's. A sensor is worth at most the difference.
    Prints them beside pd, the config's law and those of --gains, the plan without a sensor and the laws in
    --test-members unseen walks too. With --against METRIC along the front of --better and this metric too. Takes
    minutes a walk on two cores: --knots 0.2 --iterations 25 is a first look.

    --pushes finds the largest pushes on the base that half and 95 % of the walks survive, by direction and length, with
    intervals: gains of files, the config's law and pd, with and without the config's recovery. A walk is lost where a
    grip uses more than its limit, or it diverges. DIR has the table (pushes.json), each draw (pushes.nc), a picture and
    a page.

    Finished parts are kept in DIR: the same command goes on where it stopped. With --shard, or as a task of a Slurm
    array, the members are spread over machines, and the last one writes the result of all; --merge
    does so by hand.

    \b
    Examples:
      mjx-climb evaluate case_1_2 --gains results/case_1_2-tune-gradient-isotropic/gains.yaml
      mjx-climb evaluate case_2 --gains gains.yaml --retuned-pd gains-retuned_pd.yaml
      mjx-climb evaluate case_2 --gains gains.yaml --ensemble mine.yaml --members 100000 --shard 3/16
      mjx-climb evaluate case_1_2 --gains gains.yaml --hardware dynamixel_x --margins --json
      mjx-climb evaluate case_1_2 --gains gains.yaml --margins --margin contact.damping=x0.1
      mjx-climb evaluate case_2 --gains gains.yaml --worse delay=x2 --worse force_sensor.dead.LF=3.0
      mjx-climb evaluate case_2 --gains gains.yaml --pushes --push-length 0.2
      mjx-climb evaluate case_2 --ceiling --gains gains.yaml --knots 0.2 --iterations 25
      mjx-climb evaluate case_2 --ceiling --against cost_of_transport --knots 0.2 --iterations 25
    """
    again = "the same command, with config.yaml and --ensemble ensemble.yaml"
    walk_rows(rivals, walk, output, "evaluate", again)
