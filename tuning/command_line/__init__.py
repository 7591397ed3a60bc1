"""The program `mjx-climb`. Nothing is imported before it watches signals, see `tuning.command_line.interruption`."""

from collections.abc import Sequence
from typing import NoReturn


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """Run the program with the process's arguments, or others, and exit."""
    from tuning.command_line import interruption

    interruption.watch()
    import gc
    import sys
    import traceback

    gc.set_threshold(10_000, 10, 100)  # at its own pace it looks for garbage among all that was just imported

    from tuning.command_line import processes, program

    try:
        code = program.run(sys.argv[1:] if arguments is None else arguments)
    except Exception:
        if not processes.several():
            raise
        traceback.print_exc()
        code = 1
    finally:
        interruption.finish()
    processes.leave(code)
    sys.exit(code)
