"""A single computation at a time, for the newest task."""

import threading
from functools import partial

import pytest

from apt_evap.explore.newest_task import NewestTaskRunner

SECONDS = 30  # until a test gives up


class Gate:
    """Work that waits until it may go on, and notes what it was asked for."""

    def __init__(self):
        self.done, self.started, self.go = [], threading.Semaphore(0), threading.Semaphore(0)

    def __call__(self, task):
        self.started.release()
        assert self.go.acquire(timeout=SECONDS)
        self.done.append(task)
        if task == "bad":
            raise ValueError(task)

    def wait(self):
        assert self.started.acquire(timeout=SECONDS)


def test_replaced_tasks_are_not_called():
    gate = Gate()
    runner = NewestTaskRunner()
    runner.submit(partial(gate, 0))
    gate.wait()
    assert not runner.has_newer
    for task in range(1, 100):
        runner.submit(partial(gate, task))
    assert runner.has_newer
    gate.go.release()
    gate.wait()
    assert not runner.has_newer  # the last one is under way
    gate.go.release()
    runner.close()
    assert gate.done == [0, 99]


def test_one_at_a_time_and_none_is_lost():
    """Of many tasks from several threads, two never run at once, and the last one of every burst is computed."""
    running, most, done = 0, 0, []
    lock = threading.Lock()

    def work(task):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        done.append(task)
        with lock:
            running -= 1

    runner = NewestTaskRunner()
    for burst in range(50):
        threads = [
            threading.Thread(target=runner.submit, args=(partial(work, (burst, number)),)) for number in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        runner.submit(partial(work, (burst, "last")))
    runner._pool.submit(lambda: None).result(SECONDS)  # after all that was submitted before
    runner.close()
    assert most == 1 and done[-1] == (49, "last")
    assert [burst for burst, _ in done] == sorted(burst for burst, _ in done)


def test_an_error_does_not_end_it():
    gate = Gate()
    runner = NewestTaskRunner()
    for task in ("bad", "good"):
        runner.submit(partial(gate, task))
        gate.wait()
        gate.go.release()
        runner._pool.submit(lambda: None).result(SECONDS)
    runner.close()
    assert gate.done == ["bad", "good"]


def test_nothing_is_asked_of_a_closed_one():
    runner = NewestTaskRunner()
    runner.close()
    with pytest.raises(RuntimeError):
        runner.submit(print)
