"""Pictures of searches: rounds of many points show the best of each, so that the map below is seen."""

import numpy as np
import xarray as xr

from tuning.report import pictures


def test_of_rounds_of_many_points_the_best_is_drawn():
    many, few = pictures.CROWD + 1, 3
    rounds = np.repeat([0, 1, 2, 3], [few, many, many, many])
    value, penalty = np.full(rounds.size, 2.0), np.zeros(rounds.size)
    value[few + 5], value[few + many + 7], value[few + many + 8] = 1.0, 0.5, np.nan
    value[-many:] = np.nan  # nobody walked to the end
    value[few + 6], penalty[few + 6] = 0.1, 9.0  # beyond a limit
    history = xr.Dataset(
        {name: ("point", v) for name, v in (("round", rounds), ("value", value), ("penalty", penalty))}
    )
    assert pictures.best_of_crowds(history).tolist() == [few + 5, few + many + 7]
    assert pictures.crowded(history).tolist() == [False] * few + [True] * 3 * many
    few_points = history.isel(point=slice(0, few))
    assert not pictures.best_of_crowds(few_points).size and not pictures.crowded(few_points).any()
