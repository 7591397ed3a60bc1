"""Short walks of unusual robots against histories and metrics that were approved; no value is left at its default."""

import dataclasses
import os
import re
from pathlib import Path

import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.control import LAWS, SHIPPED
from mjx_climb.inputs.from_scenario import own_parameters
from mjx_climb.scenario.kinds import shipped_kinds
from mjx_climb.walk.sample import Quantities
from tests.walk.reference_walks import WALKS, scenario_of, walked

APPROVED = Path(__file__).parent / "approved"
# Shares of a walk. Whether a foot that lifts off in the first step touches the ground is a matter of rounding, which
# moves its anchor by 1e-7 m: of the motion at 0.03 that was 1e-3, with another BLAS, of that at 0.12 it is 1e-4.
AT = (0.12, 0.31, 0.66, 1.0)
# XLA at its own optimisation differs by up to 9e-5 from what the tests compile
RELATIVE, OF_LINE = 3e-4, 1e-5


@pytest.fixture(scope="module", params=WALKS)
def walk(request, tmp_path_factory):
    return request.param, walked(request.param, tmp_path_factory.mktemp("walk"))


def lines_of(walk) -> dict[str, np.ndarray]:
    """Return each quantity at some times, and each metric.

    Of a quantity of several components the number is their sum, the first once, the second twice, and so on.
    """
    rows = [min(int(share * len(walk.time)), len(walk.time) - 1) for share in AT]
    found = {}
    for field in dataclasses.fields(Quantities):
        values = np.asarray(getattr(walk, field.name), float)[rows].reshape(len(rows), -1)
        found[field.name] = np.nan_to_num(values, posinf=1e9, neginf=-1e9) @ np.arange(1.0, values.shape[1] + 1)
    metrics = mc.metrics(walk)
    if metrics["detached_limb"] is not None:
        metrics["detached_limb"] = walk.limbs.index(metrics["detached_limb"])
    metrics = {name: np.nan if value is None else float(value) for name, value in metrics.items()}
    return found | {f"metric {name}": np.array([value]) for name, value in metrics.items()}


@pytest.mark.slow
def test_a_short_walk_is_the_one_that_was_approved(walk):
    name, made = walk
    file, found = APPROVED / f"{re.sub('[^a-z]+', '_', name.lower())}.txt", lines_of(made)
    if os.environ.get("APPROVE"):
        file.parent.mkdir(exist_ok=True)
        words = {key: " ".join(f"{value:.9g}" for value in values) for key, values in found.items()}
        file.write_text("".join(f"{key}: {value}\n" for key, value in words.items()))
    known = dict(line.split(": ") for line in file.read_text().splitlines())
    assert list(found) == list(known)
    for key, text in known.items():
        values = np.array(text.split(), float)
        within = OF_LINE * np.abs(np.nan_to_num(values)).max()
        np.testing.assert_allclose(found[key], values, rtol=RELATIVE, atol=within, err_msg=key)


def values_given(scenario: mc.Scenario) -> dict[str, bool]:
    """Return whether each value of a walk's components is another than its class's own, by name.

    Grips of all kinds have the values of a spring in common.
    """
    found = {}
    for place, component in own_parameters(scenario).components.items():
        fields = {field.name: field for field in dataclasses.fields(component)}
        for name in component.VALUES:
            own, field = np.asarray(getattr(component, name)), fields[name]
            made = () if field.default_factory is dataclasses.MISSING else field.default_factory()
            default = made if field.default is dataclasses.MISSING else field.default
            key = f"{re.sub('[.][0-9]+', '', place)}.{name}"
            same = own.shape[own.ndim - np.ndim(default) :] == np.shape(default) and bool((own == default).all())
            found[key] = found.get(key, False) or not same
    return found


def test_together_the_walks_give_every_value_another_than_its_default(tmp_path):
    """Laws' gains too; every shipped kind of component, rule of footholds and law is there."""
    given, gains, kinds = {}, set(), set()
    for name, (law, values, _) in WALKS.items():
        scenario = scenario_of(name, tmp_path)
        given = {key: given.get(key, False) or changed for key, changed in (given | values_given(scenario)).items()}
        gains |= {*values}
        own = (scenario.contact, scenario.hardware.servo, scenario.gait.footholds, *scenario.disturbance.others)
        kinds |= {*re.split("[+@]", law or ""), *(str(getattr(each, "kind", each)) for each in own)}
    missing = {key for key, changed in given.items() if not changed and f"recovery_{key.split('.')[-1]}" not in gains}
    assert not missing
    assert {name for law in SHIPPED.values() for name in law.GAINS} <= gains
    shipped = {kind for place in ("contact", "hardware.servo", "gait.footholds") for kind in shipped_kinds(place)}
    of_the_paper = {law.__name__ for law in LAWS.values()}
    assert {*SHIPPED, *shipped, *shipped_kinds("disturbance.others")} - of_the_paper <= kinds
