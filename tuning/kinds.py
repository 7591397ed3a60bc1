"""The rivals of each kind of result, and the contents of its folder: `tuning.write`.

A kind's file of `tuning/pages/` says both: `compare(found, stage, folder, begun)`, of works begun before, where there
are rivals, and `contents(found: Kind, compared, name)`, of a config's name.
"""

import importlib
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_climb.scenario.kinds import named_in
from tuning import pages
from tuning.background import Stage, silent
from tuning.comparisons import of_search, of_sweep
from tuning.identification import fit, plan
from tuning.pages.contents import Contents, Written, files_of
from tuning.pages.page import Origin
from tuning.pages.section import SectionOf, load_section, sections_of
from tuning.results.result import Result
from tuning.writing import folder as folders
from tuning.writing import record

if TYPE_CHECKING:
    from tuning.identification.fit.result import Identified
    from tuning.identification.plan.excitation import Excited

Begun = of_search.Begun | of_sweep.Begun
# modules by the names of the classes of results
_PAGES = {
    name: f"{room.__name__}.{file}"
    for room in (pages, fit, plan)
    for name, file in named_in(Path(room.__path__[0]), r"^def contents\(found: (\w+), ").items()
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
    answer: Callable[[Written], None] = lambda _: None,
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
        answer: called with tables and verdicts, before anything is written.

    Raises:
        ConfigError: over an ensemble, some gains diverge in each member; a section fails.
        OutputError: a file cannot be written, or the folder holds another command's result.
    """
    home = Path(folder)
    record.check_own(home, found.FILE)
    kind = importlib.import_module(_PAGES[type(found).__name__])
    own = [load_section(each) if isinstance(each, str) else each for each in sections]
    compared = kind.compare(found, stage, home, begun) if hasattr(kind, "compare") else None
    made = kind.contents(found, compared, _name(origin))
    answer(made.written)
    told = sections_of(own, found, compared)
    how: dict[str, Any] = {"origin": origin, "figures": figures, "stage": stage, "settings": settings}
    return folders.write(made, home, f"tuning.{found.KIND}(...)", sections=told, **how)


def write_found(
    found: Result, folder: Path, origin: Origin | None = None, settings: Mapping[str, Any] | None = None
) -> None:
    """Write settings, gains and data of a search that goes on from there; `settings` as of `write`."""
    record.check_own(folder, found.FILE)
    made = Contents(Written(), found.problem, files_of(found, _name(origin)))
    folders.write(made, folder, f"tuning.{found.KIND}(...)", settings=settings, finished=False)


def _name(origin: Origin | None) -> str:
    return "from Python" if origin is None else origin.name
