"""The numbers of a scenario, for JAX and for NumPy."""

import jax
import numpy as np
import pytest

import mjx_climb as mc
from mjx_climb.quantities.parameters import own_parameters


@pytest.mark.parametrize("hardware", [(), ["hardware.force_sensor.delay=0.002"]])
def test_parameters_in_numpy_are_those_of_jax(case, hardware):
    """To the last bit, where no array of JAX is made: a GPU would have to start for it."""
    scenario = mc.load_scenario("case_1_2", hardware)
    with jax.transfer_guard("disallow"):
        mine = own_parameters(scenario)
    for name, value in vars(mc.parameters(scenario)).items():
        own = getattr(mine, name)
        assert isinstance(own, np.ndarray) and own.dtype == value.dtype == np.float64
        np.testing.assert_array_equal(own, value, err_msg=name)
