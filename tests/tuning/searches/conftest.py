"""What the tests of the searches share."""

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
