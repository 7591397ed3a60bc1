"""Draw docs/images/gradients.png: two metrics and their derivatives across grip changes and a change of the peak.

Run from the repository's root: `python docs/explanation/gradients.py`.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

import mjx_climb as mc  # noqa: E402
from mjx_climb.viz import plots  # noqa: E402

STIFFNESS = 3e3  # N/m, N m/rad
DAMPING = np.geomspace(70, 130, 361)  # N s/m, N m s/rad
METRICS = {"peak_pull_force": "peak pulling force [N]", "peak_foot_force": "peak foot force [N]"}
TITLES = {
    "peak_pull_force": "jumps where a contact comes or goes",
    "peak_foot_force": "a kink where the largest is another",
}
OVERRIDES = {"duration": 2.2, "disturbance.cargo.start": 0.5}


def walked(scenario: mc.Scenario, damping: np.ndarray) -> tuple[dict, dict]:
    """Return metrics and their derivatives by log damping, (B,) each, in float64."""
    simulate = mc.simulator(scenario, smooth=True)

    def metrics(log_damping):
        gains = mc.Gains(1.0, jnp.exp(log_damping)[:, None] * jnp.ones(6), STIFFNESS)
        found = simulate(gains, mc.parameters(scenario))
        return {name: found[name] for name in METRICS}

    with jax.enable_x64(True):
        logs = jnp.log(jnp.asarray(damping))
        run = jax.jit(lambda x: jax.jvp(metrics, (x,), (jnp.ones_like(x),)))
        return jax.tree.map(np.asarray, run(logs))


def contacts(scenario: mc.Scenario, damping: float) -> set[tuple[str, str, float]]:
    """Return which foot came to the ground, or left it, when (s)."""
    walk = mc.rollout(scenario, mc.Gains(1.0, damping, STIFFNESS))
    events = set()
    for what, there in (("comes", walk.contact), ("goes", ~walk.contact)):
        for step, limb in zip(*np.nonzero(there[1:] & ~there[:-1]), strict=True):
            events.add((walk.limbs[limb], what, round(float(walk.time[step + 1]), 6)))
    return events


def jumps(values: np.ndarray, slopes: np.ndarray, step: float) -> np.ndarray:
    """Return between which neighbours (index of the first) a metric does what its derivative does not tell."""
    missed = np.abs(np.diff(values) - step * (slopes[1:] + slopes[:-1]) / 2)
    return np.nonzero(missed > 50 * np.median(missed) + 2e-4 * np.abs(values).max())[0]


def draw(values: dict, slopes: dict) -> Figure:
    """Draw values above derivatives, one metric below the other: as wide as a phone."""
    step = np.log(DAMPING[1] / DAMPING[0])
    with plots.style():
        figure = Figure(figsize=(plots.COLUMN, 6), layout="constrained")
        axes = figure.subplots(4, 1, sharex=True)
        for above, below, (name, label) in zip(axes[::2], axes[1::2], METRICS.items(), strict=True):
            difference = (values[name][2:] - values[name][:-2]) / (2 * step)
            above.plot(DAMPING, values[name], ".", color=plots.BLUE, markersize=2.5)
            above.set_ylabel(label)
            above.set_title(TITLES[name])
            below.plot(DAMPING, slopes[name], color=plots.SKY, linewidth=3, label="forward mode")
            below.plot(DAMPING[1:-1], difference, ".", color=plots.BLACK, markersize=1.5, label="central difference")
            low, high = slopes[name].min(), slopes[name].max()
            below.set_ylim(low - 0.3 * (high - low), high + 0.3 * (high - low))
            below.set_ylabel("derivative by log D [N]")
            for panel in (above, below):
                for at in jumps(values[name], slopes[name], step):
                    panel.axvline(np.sqrt(DAMPING[at] * DAMPING[at + 1]), color="0.8", linewidth=0.6, zorder=0)
        axes[1].legend(loc="upper left")
        axes[-1].set_xlabel("damping D, all axes [N s/m, N m s/rad]")
    return figure


def main() -> None:
    """Walk, name what changes at each jump, and draw."""
    scenario = mc.load_scenario(ROOT / "configs" / "case_1_1.yaml", OVERRIDES)
    values, slopes = walked(scenario, DAMPING)
    step = np.log(DAMPING[1] / DAMPING[0])
    for name in METRICS:
        for at in jumps(values[name], slopes[name], step):
            before, after = (contacts(scenario, DAMPING[at + side]) for side in (0, 1))
            change = values[name][at + 1] - values[name][at]
            print(f"{name}: {change:+.4f} N at D = {DAMPING[at]:.2f}; {before - after} -> {after - before}")
    draw(values, slopes).savefig(ROOT / "docs" / "images" / "gradients.png", dpi=150)


if __name__ == "__main__":
    main()
