"""In processes of their own: importing writes no file, touches no device, is light, and a forked child says so."""

import multiprocessing
import os
import subprocess
import sys

import pytest

IMPORTED = """
import contextlib
import sys

with contextlib.suppress(ImportError):
    import filelock  # of JAX 0.11, which tries in a temporary folder what links do

written = []

def watch(event, arguments):
    # flags: write, read and write, create, truncate
    if event == "open" and isinstance(arguments[2], int) and arguments[2] & 0o1103:
        written.append(arguments[0])
    elif event in ("os.mkdir", "os.rename", "os.remove", "os.symlink", "os.link"):
        written.append(arguments[0])

sys.addaudithook(watch)
import mjx_climb as mc
mc.load_scenario("case_2")
assert not {"jax", "mujoco"} & set(sys.modules), "a command line that only reads a scenario waits for JAX"
from jax._src import xla_bridge

assert mc.rollout
readers = {"scipy.special", "trimesh", "rosbags"} & set(sys.modules)
assert not readers, f"a walk waits for what readers of files alone need: {readers}"
assert not xla_bridge._backends, "a JAX backend was started"
written = [path for path in written if isinstance(path, str) and path != "/dev/null"]  # a number is a pipe
assert not written, written
"""
FORKED = """
import os, sys
import jax
import mjx_climb as mc

if sys.argv[1] == "late":
    jax.devices()
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
scenario = mc.load_scenario("case_1_2", {"duration": 0.01})
calls = [mc.rollout, mc.rollout_metrics, mc.rollout_histories, lambda s: mc.simulator(s)()]
said = set()
for call in calls if sys.argv[1] == "late" else [mc.parameters]:
    try:
        call(scenario)
    except RuntimeError as error:
        said.add(str(error))
print(said, flush=True)
os._exit(0)
"""


SWEPT = """
import os, sys
import mjx_climb as mc

def walk(*_, **__):
    late = {"matplotlib", "xarray", "pandas", "jinja2", "PIL", "tuning.comparisons.of_sweep"}
    os.write(1, f"{late & set(sys.modules)}\\n".encode())
    os._exit(0)

mc.rollout_histories = walk
from tuning.command_line import main
main(["sweep", "case_1_2", "--stiffness", "1e3:1e4:2", "--damping", "1e2:1e3:2", "--out", sys.argv[1]])
"""


def printed(program, *arguments, **how):
    """Run a program in a process of its own to its end, and return what it prints."""
    command = [sys.executable, "-W", "ignore", "-c", program, *arguments]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, **how)
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.slow
def test_import_writes_nothing_and_starts_no_device(tmp_path):
    """With a home that does not exist: no file is opened for writing, no folder made, no JAX backend started."""
    home, ours = tmp_path / "nowhere", ("XDG_", "MJX_CLIMB_", "JAX_")
    environment = {key: value for key, value in os.environ.items() if not key.startswith(ours)}
    environment |= {"HOME": str(home), "MPLCONFIGDIR": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    assert printed(IMPORTED, env=environment) == ""
    assert not home.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "before",
    ["tuning.writing.record", "tuning.proposal.propose, tuning.comparisons.first_walks",
     "tuning.identification.model.replay, tuning.identification.readers"],
    ids=["run", "robot", "replay"],
)  # fmt: skip
def test_walks_do_not_wait_for_what_draws_and_labels_them(before):
    late = "{'matplotlib', 'xarray', 'pandas', 'PIL'}"
    assert printed(f"import sys, {before}; print({late} & set(sys.modules))") == "set()\n"


@pytest.mark.slow
def test_the_first_walk_of_a_sweep_does_not_wait_for_its_page_and_rivals(tmp_path):
    assert printed(SWEPT, tmp_path / "swept").endswith("set()\n")


@pytest.mark.slow
def test_writing_a_search_does_not_wait_for_what_identification_imports():
    assert printed("import sys, tuning.kinds; print('scipy.stats' in sys.modules)") == "False\n"


@pytest.mark.slow
@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.parametrize("when", ["late", pytest.param("early", marks=pytest.mark.nightly)])
def test_a_process_forked_from_one_that_has_computed_says_so_where_it_would_hang(when):
    said = printed(FORKED, when)
    if when == "late":
        assert said.startswith('{"this process was forked from one in which JAX had begun') and "', '" not in said
    else:
        assert said == "set()\n"
