"""One computation at a time, for the newest wish."""

import threading

import pytest

from apt_evap.explore.latest import Latest

SECONDS = 30  # until a test gives up


class Gate:
    """Work that waits until it may go on, and notes what it was asked for."""

    def __init__(self):
        self.done, self.started, self.go = [], threading.Semaphore(0), threading.Semaphore(0)

    def __call__(self, wish):
        self.started.release()
        assert self.go.acquire(timeout=SECONDS)
        self.done.append(wish)
        if wish == "bad":
            raise ValueError(wish)

    def wait(self):
        assert self.started.acquire(timeout=SECONDS)


def test_what_is_overtaken_is_left_out():
    gate = Gate()
    latest = Latest(gate)
    latest.ask(0)
    gate.wait()
    assert not latest.overtaken
    for wish in range(1, 100):
        latest.ask(wish)
    assert latest.overtaken
    gate.go.release()
    gate.wait()
    assert not latest.overtaken  # the last one is under way
    gate.go.release()
    latest.close()
    assert gate.done == [0, 99]


def test_one_at_a_time_and_none_is_lost():
    """Of many wishes from several threads, two never run at once, and the last one of each burst is computed."""
    running, most, done = 0, 0, []
    lock = threading.Lock()

    def work(wish):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        done.append(wish)
        with lock:
            running -= 1

    latest = Latest(work)
    for burst in range(50):
        threads = [threading.Thread(target=latest.ask, args=((burst, number),)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        latest.ask((burst, "last"))
    latest._pool.submit(lambda: None).result(SECONDS)  # after all that was submitted before
    latest.close()
    assert most == 1 and done[-1] == (49, "last")
    assert [burst for burst, _ in done] == sorted(burst for burst, _ in done)


def test_an_error_does_not_end_it():
    gate = Gate()
    latest = Latest(gate)
    for wish in ("bad", "good"):
        latest.ask(wish)
        gate.wait()
        gate.go.release()
        latest._pool.submit(lambda: None).result(SECONDS)
    latest.close()
    assert gate.done == ["bad", "good"]


def test_nothing_is_asked_of_a_closed_one():
    latest = Latest(print)
    latest.close()
    with pytest.raises(RuntimeError):
        latest.ask(1)
