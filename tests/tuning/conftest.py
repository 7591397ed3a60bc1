"""The program in this process."""

import pytest

from tuning.command_line import main


@pytest.fixture
def call(capsys):
    """Run the program to its end: (exit code, standard output, standard error)."""

    def call(*arguments):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        return ended.value.code, *capsys.readouterr()

    return call
