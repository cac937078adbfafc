"""Threads and processes: a forked child, two threads on one simulation."""

import multiprocessing
import pickle
import threading

import numpy as np
import pytest

import apt_evap as ae
from apt_evap._common.threads import map_of_threads
from apt_evap.simulation.flight.flight_pool import FlightSettings, fly_at_rest


def charges(tip, queue):
    queue.put(ae.evaporation.Emitter(tip, n_threads=2).charges.sum())


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_child_forked_after_threads_were_used_does_not_hang(small_tip):
    parent = ae.evaporation.Emitter(small_tip, n_threads=2)
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=charges, args=(small_tip, queue), daemon=True)
    child.start()
    try:
        assert queue.get(timeout=120) == parent.charges.sum()
    finally:
        child.kill()


def test_two_threads_do_not_run_one_simulation(small_tip):
    simulation = ae.Simulation(small_tip, n_threads=1)
    begun, go_on = threading.Event(), threading.Event()

    def wait(done, n_ions):
        begun.set()
        assert go_on.wait(60)

    runs = []
    thread = threading.Thread(target=lambda: runs.append(simulation.run(20, responses=False, progress=wait)))
    thread.start()
    try:
        assert begun.wait(60)
        with pytest.raises(ValueError, match="active in another thread"):
            simulation.run(5, responses=False, progress=False)
    finally:
        go_on.set()
        thread.join()
    more = simulation.run(5, responses=False, progress=False)
    alone = ae.Simulation(small_tip, n_threads=1).run(25, responses=False, progress=False)
    assert np.array_equal(np.concatenate([runs[0].site, more.site]), alone.site)


class Breaking:
    """Raises once it has launched ten ions."""

    def launch(self, emissions, random):
        if emissions.ions[-1] >= 10:
            raise OSError("on purpose")
        return ae.Unperturbed().launch(emissions, random)


def interrupted(tip):
    ae.Simulation(tip, n_threads=1).run(20, [Breaking()], responses=False, progress=False, batch_size=10)


@pytest.mark.parametrize("error", [ae.simulation.RunInterrupted, ae.simulation.RunNotSaved])
def test_errors_with_a_run_can_be_pickled(small_tip, error):
    run = ae.Simulation(small_tip, n_threads=1).run(5, responses=False, progress=False)
    copy = pickle.loads(pickle.dumps(error("a message", run)))
    assert type(copy) is error and str(copy) == "a message"
    assert copy.run.fingerprint() == run.fingerprint()


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="no fork here")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_an_interrupted_run_does_not_stop_a_pool(small_tip):
    with multiprocessing.get_context("fork").Pool(1) as pool:
        waiting = pool.apply_async(interrupted, [small_tip])
        with pytest.raises(ae.simulation.RunInterrupted, match="on purpose"):
            waiting.get(timeout=60)


@pytest.mark.parametrize("make", [ae.Simulation, ae.evaporation.Emitter])
def test_what_cannot_be_pickled_says_what_to_do(small_tip, make):
    with pytest.raises(TypeError, match=r"cannot be pickled or copied: .*make a new"):
        pickle.dumps(make(small_tip))


def test_one_thread_starts_none(small_tip, monkeypatch, tmp_path):
    """Where no threads can be started, as in a browser."""
    starts = np.array([[0.0, 0.0, small_tip.apex + 1.0]])
    reference = ae.Simulation(small_tip, n_threads=2).run(60, (ae.Unperturbed(), ae.RollUp(0.1)), progress=False)
    at_rest = fly_at_rest(ae.evaporation.Emitter(small_tip, n_threads=2), starts, FlightSettings())

    def refuse(*arguments, **options):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading, "_start_new_thread", refuse)
    with pytest.raises(RuntimeError, match="can't start new thread"):
        ae.Simulation(small_tip, n_threads=2).run(60, progress=False)
    run = ae.Simulation(small_tip, n_threads=1).run(60, (ae.Unperturbed(), ae.RollUp(0.1)), progress=False)
    assert run.fingerprint() == reference.fingerprint()
    run.save(tmp_path / "run.h5")
    assert ae.load(tmp_path / "run.h5").fingerprint() == reference.fingerprint()
    alone = fly_at_rest(ae.evaporation.Emitter(small_tip, n_threads=1), starts, FlightSettings())
    assert np.array_equal(alone.positions, at_rest.positions)
    with map_of_threads(1) as apply:
        assert list(apply(abs, [-1, 2])) == [1, 2]
