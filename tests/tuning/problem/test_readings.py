"""Sensors on which laws depend."""

import jax
import pytest

import mjx_climb as mc
from mjx_climb.control import PD, LoadTransfer, PlannedTransfer
from tuning.problem.evaluation import Problem
from tuning.problem.readings import readings


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
