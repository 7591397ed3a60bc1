"""Logs of a robot, one file a format: text, netCDF, rosbags and MCAP."""

import os
from pathlib import Path

import numpy as np

from mjx_climb.robot.constants import Robot
from mjx_climb.scenario.messages import ConfigError
from tuning.identification.log import Log, Signal, names
from tuning.identification.readers import csv_file
from tuning.identification.readers.csv_file import write_csv as write_csv

READERS = {".csv": csv_file.read}


def read_log(path: str | os.PathLike[str], robot: Robot, signals: None = None) -> Log:
    """Return what a robot recorded.

    Raises:
        ConfigError: no such file, another format, or no signal in it that a robot has; in one line.
    """
    path = Path(path)
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: expected a log as {', '.join(READERS)}, got {path.suffix or 'no suffix'}")
    recording = reader(path)
    table = recording.tables[""]
    if "time" not in table.times:
        raise ConfigError(f"{path}: expected a column time, got {', '.join(table.fields)}")
    known, time = set(names(robot)), table.times["time"]
    found = {}
    for name, values in table.fields.items():
        recorded = np.isfinite(values) & np.isfinite(time)
        if name in known and recorded.any():
            found[name] = Signal(time[recorded], values[recorded])
    if not found:
        raise ConfigError(f"{path}: expected columns such as {next(names(robot))}, got {', '.join(table.fields)}")
    start = min(float(signal.time[0]) for signal in found.values())
    return Log({name: Signal(signal.time - start, signal.value) for name, signal in found.items()}, str(path))
