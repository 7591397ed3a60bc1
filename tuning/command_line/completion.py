"""What a shell completes. A key press waits for it, so nothing heavy is imported; what that holds stands here again."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from mjx_climb.scenario import shipped

METRICS = (
    "peak_foot_force", "force_variation", "peak_pull_force", "peak_joint_torque", "cost_of_transport", "travel",
    "base_deviation", "min_tsm", "min_gia_margin", "joint_limit_margin",
)  # fmt: skip


def config(incomplete: str) -> list[str]:
    """Return the shipped scenarios and the YAML files that a word may become."""
    return [*_beginning(incomplete, shipped.names()), *_files(incomplete)]


def ensemble(incomplete: str) -> list[str]:
    """Return the shipped ensembles and the YAML files that a word may become."""
    return [*_beginning(incomplete, shipped.ensembles()), *_files(incomplete)]


def hardware(incomplete: str) -> list[str]:
    """Return the shipped profiles of hardware and the YAML files that a word may become."""
    return [*_beginning(incomplete, shipped.profiles()), *_files(incomplete)]


def metric(incomplete: str) -> list[str]:
    """Return the metrics that a word may become."""
    return _beginning(incomplete, METRICS)


def key(incomplete: str) -> list[str]:
    """Return the keys of a scenario that a word may become."""
    from mjx_climb.scenario.messages import keys
    from mjx_climb.scenario.model import Scenario

    return _beginning(incomplete, (f"{name}=" for name in keys(Scenario)))


def one_of(words: Sequence[str]) -> Callable[[str], list[str]]:
    """Return what completes one of some words."""

    def complete(incomplete: str) -> list[str]:
        return _beginning(incomplete, words)

    return complete


def _beginning(incomplete: str, words: Iterable[str]) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]


def _files(incomplete: str) -> list[str]:
    """Return YAML files of this folder; below other folders the shell itself completes."""
    return _beginning(incomplete, sorted(str(file) for file in Path().iterdir() if file.suffix in (".yaml", ".yml")))
