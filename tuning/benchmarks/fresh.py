"""Times that only a fresh process can tell: `python -m tuning.benchmarks.fresh value|gradient BATCH STEPS ENGINE`.

It compiles and runs a walk of a batch, or its gradient by two gains, twice, and prints as JSON how long each took and
when the first was done. The environment says where XLA's cache is.
"""

import json
import os
import signal
import subprocess
import sys
import time


def measure(what: str, batch: int, steps: int, engine: str, cache: str) -> dict[str, float]:
    """Return seconds from a process's start to its first result, of that result and of the same again.

    Arguments:
        what: "value" or "gradient".
        batch, steps, engine: of the walk.
        cache: folder of XLA's cache, "off" for none.
    """
    command = [sys.executable, "-m", "tuning.benchmarks.fresh", what, str(batch), str(steps), engine]
    environment = {name: v for name, v in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"MJX_CLIMB_CACHE": cache, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    begin = time.time()
    output = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout
    told = json.loads(output.splitlines()[-1])
    return {"from_start": told["done"] - begin, "first": told["first"], "again": told["again"]}


def main() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a terminal interrupts its whole family: the parent says it
    from tuning.benchmarks import programs

    what, batch, steps, engine = sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
    begin = time.perf_counter()
    run = programs.walk(batch, steps, engine) if what == "value" else programs.gradient(2, batch, steps, engine)
    seconds: list[float] = []
    for _ in range(2):
        run()
        if not seconds:
            done = time.time()
        seconds.append(time.perf_counter() - begin)
        begin = time.perf_counter()
    print(json.dumps({"first": seconds[0], "again": seconds[1], "done": done}))


if __name__ == "__main__":
    main()
