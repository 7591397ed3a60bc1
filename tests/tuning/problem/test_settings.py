"""Settings are as strict as a scenario, but for what is typed at the shell."""

import numpy as np
import pytest

import mjx_climb as mc
from tuning.command_line.from_models import made
from tuning.problem.ensemble import Ensemble
from tuning.problem.search import Judge, Search


@pytest.mark.parametrize(
    ("kind", "values", "said"),
    [
        (Ensemble, {"members": True}, "ensemble: members: expected a whole number, got true"),
        (Ensemble, {"grip_stiffness": ["0.5", True]}, "ensemble: grip_stiffness.0: expected a number, got '0.5'"),
        (Ensemble, {"cargo": 3}, "ensemble: cargo: expected a mapping, got 3"),
        (Search, {"inertia": 1}, "search: inertia: expected true or false, got 1"),
        (Search, {"pins": {"damping": "1"}}, "search: pins.damping: expected a number, got '1'"),
        (Search, {"starst": 1}, "search: starst: expected a known key, got an unknown one"),
        (Search, {"bounds": {"damping": [2, 1]}}, "search: bounds.damping: expected low < high, got 2, 1"),
    ],
)
def test_settings_of_another_type_are_refused_in_one_line(kind, values, said):
    with pytest.raises(mc.ConfigError) as refused:
        kind.make(values)
    assert str(refused.value) == said


def test_numbers_of_numpy_and_lists_are_settings_and_texts_are_where_they_are_typed():
    assert Judge(members=np.int64(3)).members == 3
    assert Search(bounds={"damping": [1, 2.0]}).bounds == {"damping": (1.0, 2.0)}
    typed = {"pins": {"damping": "1"}, "bounds": {"stiffness": ["1", "2"]}, "seed": "3"}
    search = made(Search, typed)
    assert (search.pins, search.bounds, search.seed) == ({"damping": 1.0}, {"stiffness": (1.0, 2.0)}, 3)
