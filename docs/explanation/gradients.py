"""Draw docs/images/gradients.png: peak pull and its derivative over damping, by grips that hold at once and that close.

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
STEP = np.log(DAMPING[1] / DAMPING[0])
OVERRIDES = {"duration": 2.2, "disturbance.cargo.start": 0.5}
CONTACTS: dict[str, dict[str, float]] = {
    "grips that hold at once: jumps": {},
    "grips that close: kinks alone": {"contact.closing_time": 0.1, "contact.capture_distance": 0.005},
}


def walked(scenario: mc.Scenario) -> tuple[np.ndarray, np.ndarray]:
    """Return the peak pull and its derivative by log damping, (B,) each, in float64."""
    simulate = mc.simulator(scenario, smooth=True)

    def pull(log_damping):
        gains = mc.Gains(1.0, jnp.exp(log_damping)[:, None] * jnp.ones(6), STIFFNESS)
        return simulate(gains, mc.parameters(scenario))["peak_pull_force"]

    with jax.enable_x64(True):
        logs = jnp.log(jnp.asarray(DAMPING))
        run = jax.jit(lambda x: jax.jvp(pull, (x,), (jnp.ones_like(x),)))
        return jax.tree.map(np.asarray, run(logs))


def unforeseen(values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return the changes from neighbour to neighbour that the derivatives do not tell, N."""
    return np.abs(np.diff(values) - STEP * (slopes[1:] + slopes[:-1]) / 2)


def jumps(values: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Return between which neighbours (index of the first) there is a jump."""
    missed = unforeseen(values, slopes)
    return np.nonzero(missed > 50 * np.median(missed) + 2e-4 * np.abs(values).max())[0]


def main() -> None:
    """Walk under both contacts, say how large the jumps are, and draw: as wide as a phone."""
    with plots.style():
        figure = Figure(figsize=(plots.COLUMN, 6), layout="constrained")
        axes = figure.subplots(4, 1, sharex=True)
        for above, below, (title, contact) in zip(axes[::2], axes[1::2], CONTACTS.items(), strict=True):
            values, slopes = walked(mc.load_scenario(ROOT / "configs" / "case_1_1.yaml", OVERRIDES | contact))
            found = jumps(values, slopes)
            print(f"{title}: {len(found)} jumps, unforeseen changes up to {unforeseen(values, slopes).max():.2g} N")
            above.plot(DAMPING, values, ".", color=plots.BLUE, markersize=2.5)
            above.set(title=title, ylabel="peak pull [N]")
            difference = (values[2:] - values[:-2]) / (2 * STEP)
            below.plot(DAMPING, slopes, color=plots.SKY, linewidth=3, label="forward mode")
            below.plot(DAMPING[1:-1], difference, ".", color=plots.BLACK, markersize=1.5, label="central difference")
            low, high = slopes.min(), slopes.max()
            below.set(ylim=(low - 0.3 * (high - low), high + 0.3 * (high - low)), ylabel="derivative by log D [N]")
            for panel in (above, below):
                for at in found:
                    panel.axvline(np.sqrt(DAMPING[at] * DAMPING[at + 1]), color="0.8", linewidth=0.6, zorder=0)
        axes[1].legend(loc="upper left")
        axes[-1].set_xlabel("damping D, all axes [N s/m, N m s/rad]")
    figure.savefig(ROOT / "docs" / "images" / "gradients.png", dpi=150)


if __name__ == "__main__":
    main()
