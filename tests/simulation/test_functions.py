"""The public functions are methods of a simulation, and hand down all that they are given."""

import pytest

import mjx_climb as mc
from mjx_climb import functions

OWN = {"engine": "the engine", "smooth": True}
OF_METHOD = {"batch_size": 3, "dtype": "a precision"}


class Recorded:
    """A simulation that tells how it was made, and which of its methods is called with what."""

    def __init__(self, *given, **options):
        self.made = given, options

    def __getattr__(self, name):
        return lambda *given, **options: (self.made, name, given, options)


@pytest.mark.parametrize(
    ("function", "method", "given"),
    [
        (mc.rollout_metrics, "metrics", ("gains", "parameters")),
        (mc.rollout_histories, "histories", ("gains", "parameters")),
        (mc.rollout_jvp, "jvp", ("gains", "directions", "parameters")),
        (mc.rollout_vjp, "vjp", ("gains", "weights", "parameters")),
    ],
)
def test_a_function_over_a_batch_hands_down_all_that_it_is_given(function, method, given, monkeypatch):
    monkeypatch.setattr(functions, "Simulation", Recorded)
    found = function("scenario", *given, law="a law", metrics="some metrics", **OWN, **OF_METHOD)
    assert found == ((("scenario", "a law", "some metrics"), OWN), method, given, OF_METHOD)


def test_a_rollout_hands_down_all_that_it_is_given(monkeypatch):
    monkeypatch.setattr(functions, "Simulation", Recorded)
    found = mc.rollout("scenario", "gains", "parameters", law="a law", dtype="a precision", engine="the engine")
    made = ("scenario", "a law"), {"engine": "the engine"}
    assert found == (made, "rollout", ("gains", "parameters"), {"dtype": "a precision"})
