"""The program `mjx-climb`. Nothing is imported before it watches signals, see `tuning.command_line.interruption`."""


def main(arguments: list[str] | None = None) -> None:
    """Run the program with the process's arguments, or others, and exit."""
    import _signal  # type: ignore[import-not-found]  # `signal` itself imports for 10 ms

    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)  # no traceback out of the imports until it watches
    from tuning.command_line import interruption

    interruption.watch()
    import atexit
    import gc
    import os
    import sys
    import traceback
    import warnings

    def one_line(message: object, *_: object, **__: object) -> str:  # not where in the code it came up
        from mjx_climb.scenario.messages import printable

        return f"warning: {printable(str(message))}\n"

    warnings.formatwarning = one_line
    atexit.register(gc.freeze)  # at its end Python looks for garbage among all that is left: 0.6 s
    gc.set_threshold(300_000, 10, 100)  # at its own pace it looks for garbage among all that was just imported

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
    if code and processes.several():  # end at once: others would wait for this one, or it for them
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
