"""Background work: side by side, one after the other where there is one core."""

import threading

import pytest

from mjx_climb.execution import devices
from tuning.background import Gate, background, ignore


@pytest.fixture
def cores(monkeypatch):
    return lambda count: monkeypatch.setattr(devices, "usable_cores", lambda: count)


@pytest.mark.parametrize("count", [2, 16])
def test_works_run_side_by_side(cores, count):
    cores(count)
    meeting = threading.Barrier(3)  # of both works and this test
    with background() as begin:
        results = [begin(lambda _: meeting.wait(20)) for _ in range(2)]
        meeting.wait(20)
        assert sorted({result(ignore) for result in results}) <= [0, 1, 2]


def test_on_one_core_a_work_waits_until_it_is_asked_for(cores):
    cores(1)
    done = []
    with background() as begin:
        first, second = begin(lambda _: done.append(1)), begin(lambda _: done.append(2))
        assert done == []
        second(ignore)
        first(ignore)
    assert done == [2, 1]


def test_a_search_leaves_one_core_of_two_to_one_work(cores):
    """The second begins when the first has ended."""
    cores(2)
    order, go = [], threading.Event()
    with background(busy=1) as begin:
        results = [begin(lambda _: order.append(go.wait(20))), begin(lambda _: order.append("second"))]
        go.set()
        for result in results:
            result(ignore)
    assert order == [True, "second"]


@pytest.mark.parametrize("count", [1, 16])
def test_what_goes_wrong_is_raised_where_the_result_is_asked_for(cores, count):
    cores(count)
    with background() as begin:
        result = begin(lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            result(ignore)


def test_a_work_reports_to_who_waits_for_it(cores):
    cores(16)
    heard, listening = [], threading.Event()

    def work(report):
        report("unheard")
        assert listening.wait(20)
        report("heard")
        return "done"

    with background() as begin:
        result = begin(work)
        threading.Timer(0.5, listening.set).start()  # once it has been asked for
        assert result(heard.append) == "done"
    assert "heard" in heard


def test_works_that_nobody_asks_for_are_stopped(cores):
    cores(16)
    begun = threading.Event()

    def endless(report):
        begun.set()
        while True:
            report(1)
            threading.Event().wait(0.01)

    with pytest.raises(KeyboardInterrupt), background() as begin:
        begin(endless)
        assert begun.wait(20)
        raise KeyboardInterrupt


def test_a_work_that_somebody_still_waits_for_is_stopped_at_the_end_too(cores):
    cores(16)
    heard, done = threading.Event(), []

    def long(report):
        for _ in range(1000):
            report(1)
            threading.Event().wait(0.005)
        done.append("to its end")

    def wait_for(result):
        with pytest.raises(KeyboardInterrupt):
            result(lambda _: heard.set())
        done.append("stopped")

    with background() as begin:
        waiting = threading.Thread(target=wait_for, args=[begin(long)])
        waiting.start()
        assert heard.wait(20)
    waiting.join(20)
    assert done == ["stopped"]


def test_works_wait_behind_a_gate_and_are_left_where_it_never_opens(cores):
    cores(4)
    done = []
    with background() as begin, Gate() as gate:
        asked = begin(gate.behind(lambda _: done.append("first")))
        assert not done
        gate.open()
        asked(ignore)
    with background() as begin, Gate() as gate:
        begin(gate.behind(lambda _: done.append("never")))
    assert done == ["first"]
