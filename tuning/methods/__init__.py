"""Search methods: `method.py` says what one is; those of `tuning.problem.search.METHODS` have a file each."""

from tuning.methods.method import Method, Points, Request, Task, method_of

__all__ = ["Method", "Points", "Request", "Task", "method_of"]
