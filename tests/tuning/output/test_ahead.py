"""Works that do not wait for each other: side by side, one after the other where there is one core."""

import threading

import pytest

from mjx_climb.compilation import devices
from tuning.output.ahead import ahead, to_nobody


@pytest.mark.parametrize("cores", [2, 16])
def test_works_run_side_by_side(monkeypatch, cores):
    monkeypatch.setattr(devices, "usable_cores", lambda: cores)
    meeting = threading.Barrier(3)  # of both works and this test

    def meet(_):
        return meeting.wait(20)

    with ahead() as begin:
        results = [begin(meet) for _ in range(2)]
        meeting.wait(20)
        assert sorted({result(to_nobody) for result in results}) <= [0, 1, 2]


def test_on_one_core_a_work_waits_until_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 1)
    done = []
    with ahead() as begin:
        first, second = begin(lambda _: done.append(1)), begin(lambda _: done.append(2))
        assert done == []
        second(to_nobody)
        first(to_nobody)
    assert done == [2, 1]


@pytest.mark.parametrize("cores", [1, 16])
def test_what_goes_wrong_is_raised_where_the_result_is_asked_for(monkeypatch, cores):
    monkeypatch.setattr(devices, "usable_cores", lambda: cores)
    with ahead() as begin:
        result = begin(lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            result(to_nobody)


def test_a_work_tells_who_asks_for_it(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 16)
    heard, listening = [], threading.Event()

    def work(told):
        told("unheard")
        assert listening.wait(20)
        told("heard")
        return "done"

    def listener(text):
        heard.append(text)

    with ahead() as begin:
        asked = begin(work)
        threading.Timer(0.5, listening.set).start()  # once it has been asked for
        assert asked(listener) == "done"
    assert "heard" in heard


def test_works_that_nobody_asks_for_are_ended(monkeypatch):
    monkeypatch.setattr(devices, "usable_cores", lambda: 16)
    begun = threading.Event()

    def endless(told):
        begun.set()
        while True:
            told(1)
            threading.Event().wait(0.01)

    with pytest.raises(KeyboardInterrupt), ahead() as begin:
        begin(endless)
        assert begun.wait(20)
        raise KeyboardInterrupt


def test_a_search_leaves_one_core_of_two_to_one_work(monkeypatch):
    """The second begins when the first has ended."""
    monkeypatch.setattr(devices, "usable_cores", lambda: 2)
    order, go = [], threading.Event()

    def first(_):
        assert go.wait(20)
        order.append("first has ended")

    with ahead(busy=1) as begin:
        results = [begin(first), begin(lambda _: order.append("second"))]
        go.set()
        for result in results:
            result(to_nobody)
    assert order == ["first has ended", "second"]
