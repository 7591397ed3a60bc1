"""What the tests of the searches share: an interrupt, and a kill."""

import os
import subprocess
import sys
import time

import pytest


@pytest.fixture
def stop():
    """Return what a user does who presses Ctrl-C after so many rounds: `progress=stop(3)`."""

    def after(rounds):
        def progress(now):
            if now.rounds == rounds:
                raise KeyboardInterrupt

        return progress

    return after


@pytest.fixture
def killed():
    """Return a function that starts a program, and kills it some time after it has printed so many lines."""

    def run(program, *arguments, lines, delay):
        command = [sys.executable, "-c", program, *map(str, arguments)]
        environment = dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path))
        with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as process:
            for _ in range(lines):
                process.stdout.readline()
            time.sleep(delay)
            process.kill()

    return run
