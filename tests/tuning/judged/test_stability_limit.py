"""The limit of stability: what it calls unstable diverges, what it calls stable does not."""

import numpy as np
import pytest
import xarray as xr

import mjx_climb as mc
from tuning.judged import stability_limit


def swept(stiffness, damping):
    """What a sweep returns, as far as the limit reads it: the axes of its walks, in their order."""
    none = np.zeros((len(stiffness), len(damping)), bool)
    return xr.Dataset({"diverged": (("stiffness", "damping"), none)}, {"stiffness": stiffness, "damping": damping})


@pytest.mark.slow
def test_a_walk_diverges_where_the_loop_is_unstable(case):
    """The measured pose holds with the paper's damping and loses its stability before damping M / dt twenty-fold."""
    scenario = case("case_2", "measured_pose", {"duration": 1.0, "contact.holding_limit": None})
    walks = swept([5e5], [5e3, 8e3, 1.9e4, 3e4])
    radius = stability_limit.over_map(scenario, walks)
    assert radius.dims == ("stiffness", "damping")
    gains = mc.Gains(1.0, walks["damping"].values[:, None], 5e5)
    found = mc.rollout_metrics(scenario, gains, dtype=np.float64)
    lost = found["diverged"] | (found["peak_foot_force"] > 1e3)
    assert (radius.values[0] > 1 + 1e-6).tolist() == lost.tolist() == [False, False, True, True]


def test_a_large_map_has_the_limit_at_some_of_its_cells(case, monkeypatch):
    monkeypatch.setattr(
        stability_limit, "spectral_radius", lambda scenario, gains, law, engine: gains["damping"][:, 0] / 1e2
    )
    walks = swept(np.geomspace(1e2, 1e4, 200), np.geomspace(1e1, 1e3, 3))
    walks["stiffness"].attrs["units"] = "N/m"
    radius = stability_limit.over_map(case("case_2", "virtual_model"), walks)
    assert walks.assign(spectral_radius=radius)["stiffness"].attrs == {"units": "N/m"}
    assert radius.shape == (200, 3) and np.isfinite(radius[[0, -1]]).all()
    known = radius.dropna("stiffness")
    assert known.sizes["stiffness"] == 48
    np.testing.assert_allclose(known, np.broadcast_to(walks["damping"] / 1e2, known.shape))
