"""Metrics in a row, told apart by their names."""

from collections.abc import Iterable, Iterator, Sequence
from typing import overload

from mjx_climb.walk.metrics.metric import Metric

PREFIX = "smooth_"  # of the name of a companion


class MetricTable(Sequence[Metric]):
    """Metrics in order, immutable: `table + (mine,)` is a longer one, `table["travel"]` one metric by its name.

    Raises:
        ValueError: two metrics of one name, a name that no variable of Python could have, or something else than
            metrics.
    """

    __slots__ = ("_metrics",)

    def __init__(self, metrics: Iterable[Metric]):
        self._metrics = tuple(metrics)
        seen: set[str] = set()
        for metric in self._metrics:
            if not isinstance(metric, Metric):
                raise ValueError(f"metrics: expected objects of mjx_climb.Metric, got {metric!r}")
            if not metric.name.isidentifier():
                raise ValueError(f"metric {metric.name!r}: expected a name of letters, digits and underscores")
            if metric.name in seen:
                raise ValueError(f"metric {metric.name}: expected one of this name, got two")
            seen.add(metric.name)

    @property
    def names(self) -> tuple[str, ...]:
        """The names in order."""
        return tuple(metric.name for metric in self._metrics)

    def in_words(self, name: str) -> str:
        """Return what a metric is called for people, on pictures, in tables and in sentences."""
        return self[name].long_name if name in self.names else name.replace("_", " ")

    @property
    def with_companions(self) -> "MetricTable":
        """The table with the smooth companions of its metrics behind them, as a search walks it."""
        return self + tuple(metric.smooth for metric in self._metrics if metric.smooth is not None)

    @overload
    def __getitem__(self, index: int | str) -> Metric: ...

    @overload
    def __getitem__(self, index: slice) -> "MetricTable": ...

    def __getitem__(self, index: int | str | slice) -> "Metric | MetricTable":
        if isinstance(index, slice):
            return MetricTable(self._metrics[index])
        if isinstance(index, int):
            return self._metrics[index]
        for metric in self._metrics:
            if metric.name == index:
                return metric
        raise KeyError(f"metric {index}: expected one of {', '.join(self.names)}")

    def __iter__(self) -> Iterator[Metric]:
        return iter(self._metrics)

    def __len__(self) -> int:
        return len(self._metrics)

    def __add__(self, others: Iterable[Metric]) -> "MetricTable":
        return MetricTable((*self._metrics, *others))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MetricTable) and self._metrics == other._metrics

    def __hash__(self) -> int:
        return hash(self._metrics)

    def __repr__(self) -> str:
        return f"MetricTable({', '.join(self.names)})"
