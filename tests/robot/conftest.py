"""Robots' files, and the command that refuses them."""

import pytest

from tuning.command_line import main


@pytest.fixture
def saved(tmp_path):
    """Write text or bytes as a file and return its path, `saved(text, name)`."""

    def save(text, name="robot.xml"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(text if isinstance(text, bytes) else text.encode())
        return file

    return save


@pytest.fixture
def ended(capsys):
    """Run `mjx-climb robot` with some arguments; return its exit code, and what it wrote to both streams."""

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["robot", *map(str, arguments)])
        return end.value.code, *capsys.readouterr()

    return run
