"""The folder of `identify`: values, sections that other commands read, a posterior ensemble, a page."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

import mjx_climb as mc
from mjx_climb.files import dataset
from mjx_climb.robot.constants import Robot
from tuning.identification.fit import robot_files
from tuning.identification.fit.report import (
    CORRELATION,
    PREDICTION,
    RESIDUALS,
    page_of,
    plot_correlation,
    plot_prediction,
    plot_residuals,
)
from tuning.identification.fit.result import Identified
from tuning.pages.contents import Contents, Files, Picture, Written
from tuning.problem.ensemble import TILTS, Ensemble, Posterior
from tuning.problem.evaluation import Problem
from tuning.scenario_files import portable_yaml


def contents(found: Identified, *_: object) -> Contents:
    """Return the values, sections that other commands read, a posterior ensemble, pictures and page."""
    return Contents(Written(), Problem(found.scenario), functools.partial(_files, found), page_of(found).at)


def _files(found: Identified, scenario: mc.Scenario, place: Path, asked: str) -> Files:
    identified = identified_scenario(found, scenario, place)
    texts = {
        "identified.yaml": portable_yaml(identified, place),
        "hardware.yaml": _yaml({"hardware": identified.hardware.model_dump(mode="json")}),
        **({"posterior.yaml": ensemble_of(found).to_yaml()} if found.known else {}),
        found.FILE: json.dumps(_result(found, asked), indent=2) + "\n",
    }
    return texts | {
        "residuals": Picture(RESIDUALS, lambda: plot_residuals(found)),
        "autocorrelation": Picture(CORRELATION, lambda: plot_correlation(found)),
        "prediction": Picture(PREDICTION, lambda: plot_prediction(found)),
    }


def identified_scenario(found: Identified, scenario: mc.Scenario, folder: Path) -> mc.Scenario:
    """The scenario with the identified values; an identified robot is written into the folder."""
    scenario = scenario.with_overrides(found.overrides())
    robot, nominal = found.robot(), found.model.structure.robot
    asked = any(key.startswith("robot.") for key in found.estimates)
    if asked or (found.own and _differ(robot, nominal)):
        section = robot_files.write(found.scenario.robot, robot, folder / "robot.xml")
        scenario = scenario.with_overrides({"robot": section})
    return scenario


def _differ(robot: Robot, nominal: Robot) -> bool:
    ours, theirs = map(jax.tree.leaves, (robot, nominal))
    return len(ours) != len(theirs) or not all(map(np.array_equal, ours, theirs))


def ensemble_of(found: Identified) -> Ensemble:
    """Return the ensemble whose members are drawn from the posterior; all else is the scenario's own."""
    of_scenario = set(found.model.parameters.paths) | set(TILTS)
    chosen = [n for n, v in enumerate(found.model.variables) if v.key in of_scenario]
    variables = [found.model.variables[n] for n in chosen]
    lower = [max(v.lower, 0.0) if v.unit == "s" else v.lower for v in variables]
    return Ensemble(
        pushes=None, cargo=None, gravity=None, grip_stiffness=(1.0, 1.0), robot_mass=(1.0, 1.0),
        posterior=Posterior(
            keys=tuple(v.key for v in variables), log=tuple(v.log for v in variables),
            mean=tuple(found.fitted.x[chosen].tolist()),
            covariance=tuple(map(tuple, found.posterior.covariance[np.ix_(chosen, chosen)].tolist())),
            lower=tuple(lower), upper=tuple(v.upper for v in variables),
            held=tuple(key for key in found.estimates if key not in of_scenario and not key.startswith("log.")),
        ),
    )  # fmt: skip


def _yaml(data: Any) -> str:
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=110)


def _result(found: Identified, command: str) -> dict[str, Any]:
    made = dataset.provenance(found.scenario)
    made.pop("scenario")
    told = {
        name: {k: dataclasses.asdict(e) for k, e in getattr(found, name).items()} for name in ("estimates", "beside")
    }
    noise = dict(zip(found.model.windows.names, found.fitted.noise.tolist(), strict=True))
    own = {"noise": noise, "clock": found.fitted.clock, "mass": found.model.structure.mass}
    more = {"combined": list(found.combined), **own}
    made_of = {"log": found.log.source, "log_sha256": found.log.digest, "command": command, "provenance": made}
    return found.as_json() | told | more | made_of
