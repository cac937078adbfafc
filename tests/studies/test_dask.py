"""Work by a Dask cluster."""

import os
import shutil

import pytest
from sweeps import TWELVE, Killer, check_bits, planned, poison

from apt_evap.cli.main import main
from apt_evap.studies.sweep.working import run_sweep_with_dask

pytestmark = pytest.mark.dask
distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")


def test_twelve_points_by_a_cluster_whose_workers_are_killed(tmp_path, capsys):
    """With a thirteenth point that fails, and a fourteenth with the run of another one."""
    study = TWELVE + '[[points]]\n"tip.shank_angle" = 2.5\n[[points]]\n"tip.shank_angle" = 3.0\n'
    sweep = planned(tmp_path, study)
    *good, bad, wrong = sweep.keys
    poison(sweep, bad)
    cluster = distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None)
    try:
        # a local cluster kills a worker that was not back after 15 s: here, only the killer ends workers
        patience = dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})

        def workers():
            numbers = [worker.process.pid for worker in cluster.workers.values() if worker.process is not None]
            return [number for number in numbers if number and os.path.exists(f"/proc/{number}")]

        with patience, Killer(sweep, workers, most=6) as killer:
            assert sweep.state(good[0]).name == "waiting"
            states = run_sweep_with_dask(sweep, cluster.scheduler_address)
            assert set(states) == set(sweep.keys)
            shutil.copy(sweep.folder_of(wrong) / "run.h5", tmp_path / "wrong.h5")
            calls = 1
            while {sweep.state(key).name for key in good} != {"done"}:  # a task whose workers were killed four times
                run_sweep_with_dask(sweep, cluster.scheduler_address)
                calls += 1
                assert calls < 10
        shutil.copy(sweep.folder_of(good[0]) / "run.h5", sweep.folder_of(wrong) / "run.h5")
        address = cluster.scheduler_address
        assert main(["sweep", "work", str(sweep.folder), "--scheduler", "dask", "--address", address]) == 0
    finally:
        cluster.close()
    print(f"{len(killer.killed)} workers killed, {calls} calls")
    assert len(killer.killed) >= 2
    state = sweep.state(bad)
    assert state.name == "failed" and "Unobtainium" in state.message
    assert sweep.state(wrong).name == "wrong"
    assert "12 done, 0 running, 0 waiting, 1 failed, 1 wrong" in capsys.readouterr().out
    check_bits(sweep, good)
