"""The figures that an independent prototype gave for the paper's cases, without detachment."""

import pytest

import mjx_climb as mc

TABLE = [  # case, law, peak foot force N, variation N, cost of transport, final x m
    ("case_1_1", "pd", 22.87, 367, 0.90, 0.099),
    ("case_1_1", "virtual_model", 22.84, 361, 0.90, 0.099),
    ("case_1_1", "measured_pose", 21.49, 217, 1.31, 0.098),
    ("case_1_2", "pd", 4.10, 100, 0.662, 0.100),
    ("case_1_2", "virtual_model", 4.09, 94, 0.654, 0.100),
    ("case_1_2", "measured_pose", 3.04, 32, 1.16, 0.104),
    ("case_2", "pd", 6.96, 130, 1.44e5, 0.100),
    ("case_2", "virtual_model", 6.88, 123, 1.40e5, 0.100),
    ("case_2", "measured_pose", 5.67, 34, 6.5e5, 0.095),
]


@pytest.mark.parametrize(("name", "law", "peak", "variation", "cost", "final_x"), TABLE)
def test_figures_of_the_prototype(case, walk, name, law, peak, variation, cost, final_x):
    """Of each case and law; the prototype's variation and cost are given to two or three digits."""
    trajectory = walk(case(name, law, (("contact.holding_limit", None),)))
    ours = mc.metrics(trajectory)
    figures = {
        "peak_foot_force": (ours["peak_foot_force"], peak),
        "force_variation": (ours["force_variation"], variation),
        "cost_of_transport": (ours["cost_of_transport"], cost),
        "final_x": (trajectory.base_position[-1, 0], final_x),
    }
    errors = {name: mine / theirs - 1 for name, (mine, theirs) in figures.items()}
    allowed = {"peak_foot_force": 0.01, "force_variation": 0.022, "cost_of_transport": 0.03, "final_x": 0.01}
    assert all(abs(error) < allowed[name] for name, error in errors.items()), errors
