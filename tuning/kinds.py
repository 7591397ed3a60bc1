"""The rivals of each kind of result, and the contents of its folder: `tuning.write`."""

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from tuning.background import Stage, silent
from tuning.comparisons import degraded as degrading
from tuning.comparisons import of_draw, of_ensemble, of_front, of_laws, of_schedule, of_search, of_sweep
from tuning.pages import ceiling, degraded, judge, laws, pareto, robust, schedule, sweep, tune
from tuning.pages.contents import Contents, Written, files_of
from tuning.pages.page import Origin
from tuning.pages.section import SectionOf, load_section, sections_of
from tuning.results.ceiling import Bounded
from tuning.results.front import Front
from tuning.results.judged import Comparison, Degraded, Judged
from tuning.results.result import Result
from tuning.results.scheduled import Scheduled
from tuning.results.swept import Swept
from tuning.results.tuned import Robust, Tuned
from tuning.writing import folder as folders
from tuning.writing import record

if TYPE_CHECKING:
    from tuning.identification.fit.result import Identified
    from tuning.identification.plan.excitation import Excited

Begun = of_search.Begun | of_sweep.Begun


class Kind(NamedTuple):
    """A kind of result."""

    compare: Callable[..., Any]  # with a result, stages, the folder that keeps rounds, and the works begun, if any
    contents: Callable[[Any, Any, str], Contents]  # of a result, the result of `compare`, and the config's name


KINDS: Mapping[type[Result], Kind] = {
    Swept: Kind(lambda found, stage, _, *begun: of_sweep.compare(found, stage, *begun), sweep.contents),
    Tuned: Kind(of_search.compare, tune.contents),
    Robust: Kind(of_ensemble.compare, robust.contents),
    Front: Kind(lambda found, stage, _: of_front.compare(found, stage), pareto.contents),
    Comparison: Kind(lambda found, stage, _: of_laws.compare(found, stage), laws.contents),
    Judged: Kind(lambda found, stage, _: of_draw.compare(found, stage), judge.contents),
    Degraded: Kind(lambda found, *_: degrading.summary(found.data), degraded.contents),
    Bounded: Kind(lambda *_: None, ceiling.contents),
    Scheduled: Kind(lambda found, *_: of_schedule.compare(found), schedule.contents),
}


def write(
    found: "Result | Identified | Excited",
    folder: str | os.PathLike[str],
    *,
    begun: Begun | None = None,
    origin: Origin | None = None,
    figures: Collection[str] = ("png",),
    sections: Sequence[str | SectionOf] = (),
    stage: Stage = silent,
    settings: Mapping[str, Any] | None = None,
) -> Written:
    """Compare a result, test it, and write the files of its command: numbers, pictures, gains and the report.

    The files appear together at the end, in place of those of an earlier result there.

    Arguments:
        found: of a search, of `tuning.identify` or of `tuning.excite`.
        folder: where to; it is made. Rounds that the search kept there with `out=folder` are removed.
        begun: of `begin` of `tuning.comparisons.of_search` or `of_sweep`, where it was begun before the search.
        origin: of the report.
        figures: formats of the pictures, of `mjx_climb.viz.plots.FORMATS`; reports hold them as PNG anyway.
        sections: more of the report: functions of the result and of its comparison that return a
            `tuning.pages.section.Section`, or None; or FILE.py:NAME of such.
        stage: opened for each longer work, see `tuning.background.Stage`; nothing is printed.
        settings: of a command, which knows its folder again by them.

    Raises:
        ConfigError: over an ensemble, some gains diverge in each member; a section fails.
        OutputError: a file cannot be written, or the folder holds another command's result.
    """
    home = Path(folder)
    how: dict[str, Any] = {"origin": origin, "figures": figures, "stage": stage, "settings": settings}
    own = [load_section(each) if isinstance(each, str) else each for each in sections]
    if not isinstance(found, Result):
        return _of_identification(found, home, sections=sections_of(own, found, None), **how)
    record.check_own(home, found.FILE)
    kind = KINDS[type(found)]
    compared = kind.compare(found, stage, home, *([] if begun is None else [begun]))
    made, told = kind.contents(found, compared, _name(origin)), sections_of(own, found, compared)
    return folders.write(made, home, f"tuning.{found.KIND}(...)", sections=told, **how)


def _of_identification(
    found: "Identified | Excited", home: Path, settings: Mapping[str, Any] | None, origin: Origin | None, **how: Any
) -> Written:
    # imported here: the import takes a second, and searches do without
    from tuning.identification.fit import output as of_fit
    from tuning.identification.fit.result import Identified
    from tuning.identification.plan import output as of_plan

    made_by: Any = of_fit if isinstance(found, Identified) else of_plan
    record.check_own(home, made_by.FILE)
    with record.whole(home, settings) as place:
        files, page, where = made_by.contents(found, place, origin)
        return Written(folders.fill(place, files, page, where, **how))


def write_found(
    found: Result, folder: Path, origin: Origin | None = None, settings: Mapping[str, Any] | None = None
) -> None:
    """Write settings, gains and data of a search that goes on from there; `settings` as of `write`."""
    record.check_own(folder, found.FILE)
    made = Contents(Written(), found.problem, files_of(found, _name(origin)))
    folders.write(made, folder, f"tuning.{found.KIND}(...)", settings=settings, finished=False)


def _name(origin: Origin | None) -> str:
    return "from Python" if origin is None else origin.name
