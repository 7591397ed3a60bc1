"""What a search depends on beside its settings: metrics, and what the walks are computed with."""

import hashlib
import importlib.metadata
from collections.abc import Mapping
from typing import Any

import jax

import mjx_climb as mc
from mjx_climb.compilation.contents import identity as identity
from mjx_climb.files.dataset import PACKAGES
from mjx_climb.robot.constants import model_path


def of_metrics(metrics: mc.MetricTable) -> list[str]:
    """Return what tells metrics from others: the shipped ones by name, as they change with the version."""
    return [m.name if m in mc.METRICS else f"{m.name} {identity(m, f'metric {m.name}')}" for m in metrics]


def of_surroundings(scenario: mc.Scenario, packages: Mapping[str, str] = PACKAGES) -> dict[str, Any]:
    """Return what a walk depends on beside its scenario, as plain JSON values: backend, robot and versions.

    Arguments:
        scenario: names the robot.
        packages: names of distributions by what they are called here.
    """
    versions: dict[str, str | None] = {}
    for name, distribution in packages.items():
        try:
            versions[name] = importlib.metadata.version(distribution)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    return {
        "platform": jax.default_backend(),
        "robot_model": hashlib.sha256(model_path(scenario.robot).read_bytes()).hexdigest(),
        "versions": versions,
    }
