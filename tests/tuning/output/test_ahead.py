"""Works that do not wait for each other: side by side on many cores, one after the other on few."""

import threading

import pytest

from mjx_climb.compilation import devices
from tuning.output.ahead import ahead


def test_on_many_cores_works_run_side_by_side(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 16)
    meeting = threading.Barrier(3)  # of both works and this test

    def meet():
        return meeting.wait(20)

    with ahead() as begin:
        results = [begin(meet) for _ in range(2)]
        meeting.wait(20)
        assert sorted({result() for result in results}) <= [0, 1, 2]


def test_on_few_cores_a_work_waits_until_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 2)
    done = []
    with ahead() as begin:
        first, second = begin(lambda: done.append(1)), begin(lambda: done.append(2))
        assert done == []
        second()
        first()
    assert done == [2, 1]


@pytest.mark.parametrize("cores", [2, 16])
def test_what_goes_wrong_is_raised_where_the_result_is_asked_for(monkeypatch, cores):
    monkeypatch.setattr(devices, "usable_cores", lambda: cores)
    with ahead() as begin:
        result = begin(lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            result()
