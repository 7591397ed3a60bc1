"""The metrics of a walk as objects, the shipped ones among them, each accumulated step by step."""

from mjx_climb.walk.metrics.extremes import largest, peak, smallest
from mjx_climb.walk.metrics.metric import PREFIX, Context, Metric, MetricTable, total
from mjx_climb.walk.metrics.shipped import FAILURES, METRICS

__all__ = ["FAILURES", "METRICS", "PREFIX", "Context", "Metric", "MetricTable", "largest", "peak", "smallest", "total"]
