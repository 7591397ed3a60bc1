"""A process forked from one that has computed says so, where it would hang."""

import multiprocessing
import subprocess
import sys

import pytest

FORKED = """
import os, sys
import jax
import mjx_climb as mc

if sys.argv[1] == "late":
    jax.devices()
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
scenario = mc.load_scenario("case_1_2", {"duration": 0.01})
calls = [mc.rollout, mc.rollout_metrics, mc.rollout_histories, mc.Environment, lambda s: mc.simulator(s)()]
said = set()
for call in calls if sys.argv[1] == "late" else [mc.parameters]:
    try:
        call(scenario)
    except RuntimeError as error:
        said.add(str(error))
print(said, flush=True)
os._exit(0)
"""


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.parametrize("when", ["late", "early"])
def test_a_forked_child_says_that_it_cannot_walk(when):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FORKED, when], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    if when == "late":
        assert (
            done.stdout.startswith('{"this process was forked from one in which JAX had begun')
            and "', '" not in done.stdout
        )
    else:
        assert done.stdout == "set()\n"
