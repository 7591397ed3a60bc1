"""Parts that are saved while the next ones are worked out."""

import threading

import numpy as np
import pytest

from mjx_climb.files.dataset import OutputError
from tuning.searches.finished_parts import Parts, saved_beside


class Slow(Parts):
    """Saves a part when it is told to, which here means: not before the next one is worked out."""

    def __init__(self, out):
        super().__init__(out, {"a": 1})
        self.go = threading.Event()

    def save(self, number, arrays):
        assert self.go.wait(20)
        super().save(number, arrays)


def test_a_part_is_saved_beside_and_all_of_them_at_the_end(tmp_path):
    parts = Slow(tmp_path)
    with saved_beside(parts) as save:
        save(0, {"x": np.arange(2)})
        assert parts.count() == 0  # and this goes on
        parts.go.set()
        save(1, {"x": np.arange(3)})
    assert [len(parts.load(number)["x"]) for number in (0, 1)] == [2, 3]


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_what_ends_the_work_takes_no_part_with_it(tmp_path, error):
    parts = Slow(tmp_path)
    with pytest.raises(error), saved_beside(parts) as save:
        save(0, {"x": np.arange(2)})
        threading.Timer(0.2, parts.go.set).start()
        raise error
    assert parts.count() == 1


@pytest.mark.parametrize("more", [0, 1])
def test_a_folder_that_cannot_be_written_is_said(tmp_path, monkeypatch, more):
    """When the next part is to be saved, or at the end."""

    def refuse(*_):
        raise OutputError("no room")

    monkeypatch.setattr(Parts, "save", refuse)
    reached = []
    with pytest.raises(OutputError, match="no room"), saved_beside(Parts(tmp_path, {})) as save:
        for number in range(1 + more):
            save(number, {})
            reached.append(number)
    assert reached == [0]


def test_without_parts_nothing_is_saved(tmp_path):
    with saved_beside(None) as save:
        save(0, {"x": np.arange(2)})
    assert not list(tmp_path.iterdir())
