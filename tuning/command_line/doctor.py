"""`mjx-climb doctor`: is this installation sound?"""

import time
from json import dumps
from typing import Annotated

import typer

from tuning.command_line.from_models import command
from tuning.command_line.options import Output, reserved_stdout


def doctor(output: Annotated[Output, "json_only"]) -> None:
    """Examine this installation: does it compute what it should?

    Prints versions, devices, the state of the compilation cache and which OpenGL renders. Then walks half a second and
    takes its gradient by the gains, solves the equations of motion with both engines and with MuJoCo's C code, and
    compares with values stored in the package, to nine digits. Half a minute or so, twice that where the compilation
    cache is empty. Says of all that is wrong what to do about it.

    Exit code 0: all is well. 1: something is wrong.

    \b
    Examples:
      mjx-climb doctor
      mjx-climb doctor --json
    """
    with reserved_stdout() as stdout:
        from tuning.command_line import diagnosis

        begin = time.perf_counter()
        parts = diagnosis.examine()
        said = diagnosis.verdict(parts)
        sound = not any(part.findings for part in parts)
        if output.json_only:
            found = {part.name: {**part.facts, "findings": list(part.findings)} for part in parts}
            print(dumps({"sound": sound, "verdict": said, "parts": found}, indent=2, allow_nan=False), file=stdout)
        else:
            for part in parts:
                print(f"{part.name:9} {part.text}", file=stdout)
                for finding in part.findings:
                    print(f"{'':9} ! {finding}", file=stdout)
            print(f"\n{said} ({time.perf_counter() - begin:.0f} s)", file=stdout)
    raise typer.Exit(0 if sound else 1)


COMMAND = command(doctor)
