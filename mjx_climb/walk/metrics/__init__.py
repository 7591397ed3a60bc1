"""What a walk is judged by: metrics as objects, the shipped ones among them, each accumulated step by step."""

from mjx_climb.walk.metrics.extremes import largest, peak, smallest
from mjx_climb.walk.metrics.metric import Context, Metric, total
from mjx_climb.walk.metrics.shipped import FAILURES, METRICS
from mjx_climb.walk.metrics.table import PREFIX, MetricTable

__all__ = ["FAILURES", "METRICS", "PREFIX", "Context", "Metric", "MetricTable", "largest", "peak", "smallest", "total"]
