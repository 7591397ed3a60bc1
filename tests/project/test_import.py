"""Importing mjx_climb: no file written, no device touched."""

import os
import subprocess
import sys

PROGRAM = """
import sys

written = []

def watch(event, arguments):
    # flags: write, read and write, create, truncate
    if event == "open" and isinstance(arguments[2], int) and arguments[2] & 0o1103:
        written.append(arguments[0])
    elif event in ("os.mkdir", "os.rename", "os.remove", "os.symlink", "os.link"):
        written.append(arguments[0])

sys.addaudithook(watch)
import mjx_climb as mc
from jax._src import xla_bridge

assert mc.rollout
assert not xla_bridge._backends, "a JAX backend was started"
written = [path for path in written if isinstance(path, str) and path != "/dev/null"]  # a number is a pipe
assert not written, written
"""


def test_import_writes_nothing_and_starts_no_device(tmp_path):
    """With a home that does not exist: no file is opened for writing, no folder made, no JAX backend started."""
    home = tmp_path / "nowhere"
    environment = {
        key: value for key, value in os.environ.items() if not key.startswith(("XDG_", "MJX_CLIMB_", "JAX_"))
    }
    environment |= {"HOME": str(home), "MPLCONFIGDIR": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    run = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert run.stdout == ""
    assert not home.exists()
