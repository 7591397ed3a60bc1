"""Search methods: `method.py` has their base; those of `tuning.problem.search.METHODS` have a file each."""

from tuning.methods.method import Method, Points, Request, Task, method_of

__all__ = ["Method", "Points", "Request", "Task", "method_of"]
