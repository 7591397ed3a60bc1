"""The benchmark's arithmetic, and that its ratios are far from absurd: no absolute times, the machine may be busy."""

import json
import subprocess
import sys

import pytest

from tuning.benchmarks import commands, measure, operations
from tuning.command_line import machine


def test_exponent_is_the_slope_of_the_logarithms():
    sizes = (1, 2, 4, 8)
    assert measure.exponent(sizes, [3.0 * n**1.25 for n in sizes]) == pytest.approx(1.25)
    assert measure.exponent((), []) is None


def test_work_takes_turns_and_the_first_turn_does_not_count():
    order = []
    work = {"a": (1, lambda: order.append("a")), "b": (2, lambda: order.append("b"))}
    assert measure.in_turns(3, work).keys() == work.keys()
    assert order == ["a", "b"] * 4


def test_a_command_is_timed_twice_with_a_cache_of_its_own(monkeypatch):
    """The first run leaves a file in its cache and waits; the second finds it."""
    code = (
        "import os, pathlib, time; cache = pathlib.Path(os.environ['MJX_CLIMB_CACHE']); there = cache.exists();"
        "cache.mkdir(exist_ok=True); end = time.process_time() + (0 if there else 1);\n"
        "while time.process_time() < end: pass"
    )
    monkeypatch.setattr(commands, "COMMANDS", {"wait": ("-c", code)})
    told = []
    seconds = commands.measure(["wait"], told.append)["wait"]
    assert told == ["wait, cold", "wait, warm"]
    assert seconds.cold_cpu > 1 > seconds.warm_cpu and seconds.cold > 1


def test_ratios_are_how_many_times_faster_this_program_is(monkeypatch):
    seconds = {name: float(n) for n, name in enumerate(("closed_loop", "mujoco_c", "mjx", "mujoco_batch"), 1)}
    seconds |= {"value": 2.0, "gradient_2": 10.0, "single": 4.0, "numpy_loop": 12.0}
    times = {"from_start": 9.0, "first": 7.0, "again": 2.0}
    monkeypatch.setattr(commands, "compiled", lambda *_: times)
    monkeypatch.setattr(measure, "in_turns", lambda *_: seconds)
    monkeypatch.setattr(measure, "_work", lambda *_: ({}, {}, {}, {}))
    for name in ("_growth", "_operations"):
        monkeypatch.setattr(measure, name, lambda *_: {})
    result = measure.measure("limb", 1, measure.Plan(1, 2, 1, (2,), (), ()), lambda _: None)
    names = ("vs_mujoco_c", "vs_mjx", "vs_mujoco_batch", "vs_numpy_loop_single", "gradient_cost_2")
    assert [result[name] for name in names] == [2.0, 3.0, 4.0, 3.0, 5.0]
    assert [result[name] for name in ("compile_value_s", "warm_start_s", "gradient_cost_12")] == [5.0, 7.0, None]
    assert result["peers_steps_per_s"]["mjx"] == pytest.approx(1 / 3)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timing
def test_quick_bench_prints_every_figure_and_sane_ratios():
    command = [sys.executable, "-m", "tuning.command_line", "bench", "--quick", "--json", "--batch", "256"]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    result = json.loads(output)
    left_out = {"gradient_cost_12", "batch_exponent", "step_exponent", "vs_mujoco_warp"}  # the last is for GPUs
    assert {name for name, *_ in machine.ROWS} <= result.keys()
    assert left_out == {name for name, value in result.items() if value is None}
    assert result["vs_mjx"] > 1.5
    assert result["vs_mujoco_c"] > 0.2
    assert result["vs_mujoco_batch"] > 0.5
    assert result["vs_numpy_loop_single"] > 1
    assert 1 < result["gradient_cost_2"] < 10
    assert set(result["waits"]) == set(machine.QUICK)
    run = result["waits"][commands.RUN]
    assert run["warm_cpu"] < run["cold_cpu"] / 1.5
    # fusion within a piece of a step repeats some; fusion of a whole step would repeat all six times
    assert 0.85 < result["flops_per_env_step"] / operations.BY_HAND < 2
