"""The verdict on gains in one sentence: against their rivals, by name and numbers."""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

import mjx_climb as mc
from mjx_climb.inputs.resolve import AnyGains
from tuning.gains.gains_file import by_name
from tuning.numbers import change_of, number, presentable, unit
from tuning.problem.evaluation import Problem
from tuning.searches.retuned_pd import NAME, PLANNED, UNSEARCHED

OWN_SEARCH = "pd with its own kp and kd searched"
_NAMES = {"pd": "pd as the config has it", "config": "the config's gains", "paper": "the paper's gains",
          "gains file": "the gains file", PLANNED: f"load transfer by plan ({PLANNED})",
          UNSEARCHED: f"load transfer by plan, not searched, on kp and kd of pd ({UNSEARCHED})"}  # fmt: skip
_EQUAL = 5e-4  # relative; closer values have the same first three digits


class Walked(NamedTuple):
    """The score of gains, and whether they keep every limit."""

    value: float  # NaN: the walk failed
    keeps: bool = True
    bound: str = ""  # in words, where the value is no more than a bound


def by_lost_walks(means: xr.DataArray, lost: xr.DataArray) -> dict[str, Walked]:
    """Return the scores of gains from means and lost walks, (`gains`); the lost walks of the first are the limit."""
    first, *_ = names = means["gains"].values.tolist()
    most = float(lost.sel(gains=first))
    return {name: Walked(float(means.sel(gains=name)), bool(lost.sel(gains=name) <= most)) for name in names}


def in_words(name: str, joint: Mapping[str, float] | None = None) -> str:
    """Return the name of a rival for people who have not seen a table; `joint` are the gains that were searched."""
    if name != NAME:
        return _NAMES.get(name, name)
    own = ", ".join(f"{key.removeprefix('gait.')} {number(value)}" for key, value in (joint or {}).items())
    return f"{OWN_SEARCH} ({', '.join(filter(None, [NAME, own]))})"


def named(word: str, gains: AnyGains, problem: Problem) -> str:
    """Return the word with the gains that were searched behind it, where each is one number on all axes."""
    values = {name: np.unique(value) for name, value in by_name(gains).items() if name in problem.space.gains}
    if not values or any(each.size > 1 for each in values.values()):
        return word
    return f"{word} ({', '.join(f'{name} {number(each.item())}' for name, each in values.items())})"


def explained(names: Iterable[str]) -> str:
    """Return the meaning of the columns of rivals, to end a caption; nothing where a table has none."""
    words = {
        NAME: OWN_SEARCH,
        UNSEARCHED: "load transfer by plan, without a force sensor, with its default gains there",
    }
    there = set(names)
    return "".join(f"; {name}: {each}" for name, each in words.items() if name in there)


def best_rival(walked: Mapping[str, Walked], *, larger_is_better: bool = False) -> str | None:
    """Return the best of all but the first, of those that keep limits where any does; None if all walks failed."""
    sound = {name: each for name, each in list(walked.items())[1:] if math.isfinite(each.value)}
    sign = -1 if larger_is_better else 1
    return min(sound, key=lambda name: (not sound[name].keeps, sign * sound[name].value), default=None)


def against_best(
    ours: str, walked: Mapping[str, Walked], what: str, unit: str = "",
    joint: Mapping[str, float] | None = None, breaks: str = "breaks a limit", *, larger_is_better: bool = False,
) -> str:  # fmt: skip
    """Return by how much gains are better or worse than the best of their rivals, which keeps limits where any does.

    Arguments:
        ours: the gains in words.
        walked: their score, then the score of each rival, by name.
        what: the name of the score, in words, and its `unit`.
        joint: the gains of pd retuned.
        breaks: words for a rival that does not keep every limit.
        larger_is_better: whether the best score is the largest.
    """
    own, *others = walked.values()
    best = best_rival(walked, larger_is_better=larger_is_better)
    reached = f"{ours}: {_with_unit(what, own, unit)}" if math.isfinite(own.value) else f"{ours}: the walk failed"
    if best is None:
        return f"{reached}; no rival held" if others else reached
    rival, breaks = walked[best], "" if walked[best].keeps else f", which {breaks}"
    name = in_words(best, joint)
    if not math.isfinite(own.value):
        return f"{reached}; the best rival that walked is {name}: {_with_unit(what, rival, unit)}{breaks}"
    known = rival.value > 0 and not own.bound and not rival.bound
    change = own.value / rival.value - 1 if known else math.nan
    how = "beside"
    if math.isfinite(change):
        how = "the same as" if abs(change) < _EQUAL else f"{more_or_less(change)} than"
    value = _with_unit("", rival, unit)
    return f"{reached}, {how} the best rival that walked, {name}: {value}{breaks}"


def against(name: str, walk: str, walks: Mapping[str, Mapping[str, Any]], about: mc.MetricTable = mc.METRICS) -> str:
    """Return a metric of one of some walks as "47.1 N, 49.7 % below the paper's gains, 52.9 % below pd"."""
    own = walks[walk]
    text = f"{number(presentable(own)[name])} {unit(name, about)}".strip()
    for other, values in walks.items():
        if other != walk and (percent := change_of(own, values, name)):
            text += f", {percent.lstrip('+-')} % {'above' if percent[0] == '+' else 'below'} {in_words(other)}"
    return text


def more_or_less(change: float) -> str:
    """Return a relative change in words, as "10.2 % more"."""
    return f"{100 * abs(change):.1f} % {'less' if change < 0 else 'more'}"


def _with_unit(what: str, reached: Walked, unit: str) -> str:
    return " ".join(filter(None, [what, *([reached.bound] if reached.bound else [number(reached.value), unit])]))
