"""Sensors on which laws depend."""

import jax
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, LoadTransfer, PlannedTransfer
from tuning.problem.evaluation import Problem
from tuning.problem.readings import best_of_both, readings


@pytest.mark.parametrize(("law", "reads"), [(LoadTransfer, True), (PlannedTransfer, False), (PD, False)])
def test_a_law_is_looked_at_without_a_compiler(law, reads):
    """Its program tells what it reads: no number is computed."""
    seen = []

    class Watched(law):
        def init(self, start):
            seen.extend(jax.tree.leaves((self, start)))
            return super().init(start)

    assert ("forces" in readings(Problem(mc.load_scenario("case_1_2"), law=Watched()))) is reads
    assert seen and all(isinstance(value, jax.core.Tracer) for value in seen)


def test_the_best_law_is_the_least_of_those_that_read_forces_and_then_of_the_others():
    value = {"a": 3.0, "b": 1.0, "c": 2.0, "d": 0.5}.__getitem__
    assert best_of_both("abcd", {"a", "b", "x"}, value) == ["b", "d"]
    assert best_of_both("ab", {"a", "b"}, value) == ["b", None] and best_of_both("ab", (), value) == [None, "b"]
