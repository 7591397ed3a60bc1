"""Print what worse hardware takes from laws: the tables of docs/studies/worse_hardware.md.

Run from the repository's root, with the gains that a comparison left, `gains-retuned_pd.yaml` among them:
`python docs/studies/degradation.py case_1_2 results/case_1_2-laws`, with `pose` behind for a worse pose of the base.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import xarray as xr

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

import mjx_climb as mc  # noqa: E402
from mjx_climb.execution.batch_axes import own_axes  # noqa: E402
from mjx_climb.files import dataset  # noqa: E402
from mjx_climb.scenario.load import load_hardware, with_hardware  # noqa: E402
from mjx_climb.scenario.shipped import config_path  # noqa: E402
from tuning.comparisons import judge as judging  # noqa: E402
from tuning.comparisons import paired  # noqa: E402
from tuning.gains import gains_file  # noqa: E402
from tuning.problem.ensemble import Ensemble, draw  # noqa: E402
from tuning.problem.objectives import Objective  # noqa: E402

DRAWN = "as drawn"
SETTINGS = {  # by what is made worse: keys of the scenario, and of the section `hardware` of the ensemble
    "hardware": {
        DRAWN: ({}, {}),
        "force 2 ms late": ({}, {"force_delay": (0.002, 0.002)}),
        "force 30 ms late": ({}, {"force_delay": (0.03, 0.03)}),
        "1 kHz": ({}, {"control_rate": (1000.0, 1000.0)}),
        "50 Hz": ({}, {"control_rate": (50.0, 50.0)}),
        "half the friction": ({}, {"friction": (0.25, 1.0)}),
        "twice the friction": ({}, {"friction": (1.0, 4.0)}),
        "noise 0.5 N": ({}, {"force_noise": (0.5, 0.5)}),
        "LF dead from 3 s": ({"hardware.force_sensor.dead": {"LF": 3.0}}, {}),
        "bias 1 N": ({"hardware.force_sensor.bias": 1.0}, {}),
    },
    "pose": {  # the shipped profile's estimate is 5 ms late and exact
        DRAWN: ({}, {}),
        "20 ms late": ({"hardware.base_estimate.delay": 0.02}, {}),
        "noise 1 mm, 10 mm/s": (
            {"hardware.base_estimate.position_noise": 0.001, "hardware.base_estimate.velocity_noise": 0.01},
            {},
        ),
        "noise 5 mm, 50 mm/s": (
            {"hardware.base_estimate.position_noise": 0.005, "hardware.base_estimate.velocity_noise": 0.05},
            {},
        ),
    },
}
METRICS = {
    "V": "force_variation", "F": "peak_foot_force", "P": "peak_pull_force", "COT": "cost_of_transport",
    "torque": "peak_joint_torque",
}  # fmt: skip
PD = "retuned_pd"
LEAST = 0.1  # N of pull, and of every other metric, that can be compared in per cent


def all_in_one(draws: Sequence[mc.Parameters], members: int) -> mc.Parameters:
    """Return the members of all draws behind one another, so that a law is compiled once for all of them."""

    def joined(own: int, *values: np.ndarray) -> np.ndarray:
        values = tuple(map(np.asarray, values))
        if all(value.ndim == own and np.array_equal(value, values[0]) for value in values):
            return values[0]
        shape = np.broadcast_shapes(*(value.shape[value.ndim - own :] for value in values))
        return np.concatenate([np.broadcast_to(value, (members, 1, *shape)) for value in values])

    return jax.tree.map(joined, own_axes(draws[0]), *draws)


def parameters_of(scenario: mc.Scenario, ensemble: Ensemble, worse: str) -> mc.Parameters:
    """Return what no search has seen, in each setting: members differ between settings in that alone."""
    draws = []
    for keys, ranges in SETTINGS[worse].values():
        hardware = ensemble.hardware.model_copy(update=ranges)
        drawn = judging.fresh(ensemble.model_copy(update={"hardware": hardware}))
        draws.append(draw(scenario.with_overrides(keys), drawn))
    return all_in_one(draws, ensemble.members)


def walked(scenario: mc.Scenario, one: gains_file.Whole, parameters: mc.Parameters, worse: str) -> xr.Dataset:
    """Return the metrics of a law's walks by setting and member."""
    metrics = mc.MetricTable(mc.METRICS)
    how = {"law": one.law, "metrics": metrics, "dtype": np.float32, "smooth": True}
    found = mc.rollout_metrics(scenario, one.gains, parameters, **how)
    dims = ("setting", "member")
    data = {
        each.name: (dims, np.reshape(found[each.name], (len(SETTINGS[worse]), -1)), dataset.metric_attributes(each))
        for each in metrics
    }
    return xr.Dataset(data, {"setting": list(SETTINGS[worse])}, {"holding_limit": scenario.contact.holding_limit})


def difference(table: xr.Dataset, metric: str, place: str) -> str:
    """Return by how many per cent a mean differs from the baseline's, ~ where its 95 % interval holds 0.

    It is the value itself where the baseline has next to nothing.
    """
    own = table.sel(metric=metric, statistic="mean")
    base = float(own["value"].sel(gains=table.attrs["baseline"]))
    if abs(base) < LEAST:
        return f"{float(own['value'].sel(gains=place)):.2g}"
    text = f"{100 * float(own['difference'].sel(gains=place)) / base:+.0f}"
    if text in ("+0", "-0"):
        return "0"
    return text if bool(own["real"].sel(gains=place)) else f"~{text}"


def row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def print_losses(walks: xr.Dataset) -> None:
    """Print the change of each law against its own walks as drawn, and how many of its walks are lost."""
    laws, settings = walks["gains"].values.tolist(), walks["setting"].values.tolist()
    print(row("", "law", *settings))
    print("|---" * (len(settings) + 2) + "|")
    own = {law: walks.sel(gains=law, drop=True).rename(setting="gains") for law in laws}
    tables = {law: paired.compared(own[law], [*METRICS.values()], DRAWN, Objective((), ())) for law in laws}
    for short, metric in METRICS.items():
        for law, table in tables.items():
            value = float(table["value"].sel(metric=metric, statistic="mean", gains=DRAWN))
            print(row(short, law, f"{value:.3g}", *(difference(table, metric, name) for name in settings[1:])))
    for law, table in tables.items():
        lost = table["value"].sel(metric="failed", statistic="mean") * walks.sizes["member"]
        print(row("lost", law, *(f"{float(lost.sel(gains=name)):.0f}" for name in settings)))


def print_lead(walks: xr.Dataset) -> None:
    """Print each law's difference from pd in the same setting."""
    laws, settings = [law for law in walks["gains"].values.tolist() if law != PD], walks["setting"].values.tolist()
    print(row("", "law", *settings))
    print("|---" * (len(settings) + 2) + "|")
    goal = Objective((), ())
    tables = {name: paired.compared(walks.sel(setting=name), [*METRICS.values()], PD, goal) for name in settings}
    for short, metric in METRICS.items():
        for law in laws:
            print(row(short, law, *(difference(tables[name], metric, law) for name in settings)))


def main(case: str, folder: str, worse: str = "hardware", members: int = 128) -> None:
    scenario = mc.load_scenario(config_path(f"{case}.yaml"), {"duration": 16.0})
    scenario = with_hardware(scenario, load_hardware("dynamixel_x"))
    ensemble = Ensemble.load(ROOT / "configs/ensemble_dynamixel_x.yaml").model_copy(update={"members": members})
    parameters, walks = parameters_of(scenario, ensemble, worse), {}
    for gains in sorted(Path(folder).glob("gains-*.yaml")):
        name, kept = gains.stem.removeprefix("gains-"), gains.with_suffix(f".{worse}.nc")
        if not kept.exists():
            walked(scenario, gains_file.whole(gains, scenario), parameters, worse).to_netcdf(kept)
        walks[name] = xr.load_dataset(kept)
    both = xr.concat(walks.values(), xr.Variable("gains", list(walks)), combine_attrs="override")
    print_losses(both)
    print()
    print_lead(both)


if __name__ == "__main__":
    main(*sys.argv[1:])
