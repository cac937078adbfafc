import os

import pytest
from sweeps import TWELVE, Killer, check_bits, check_journal, planned, poison

from apt_evap.sweep.pool import work_with_dask

pytestmark = pytest.mark.dask


def test_twelve_points_by_a_dask_cluster_whose_workers_are_killed(tmp_path):
    """With a thirteenth, poisoned point, and without processes that remain."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    sweep = planned(tmp_path, TWELVE + '[[points]]\n"tip.shank_angle" = 2.5\n')
    bad = sweep.keys[-1]
    poison(sweep, bad)
    cluster = distributed.LocalCluster(n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None)
    try:
        # a local cluster kills a worker that was not back after 15 s: here, only the killer ends workers
        patience = dask.config.set({"distributed.deploy.lost-worker-timeout": "1 hour"})
        with patience, Killer(sweep, 5.0, most=8) as killer:
            work_with_dask(sweep, cluster.scheduler_address)
    finally:
        cluster.close()
    states = {point.key: state for point, state in sweep.states()}
    assert states[bad].name == "failed" and "Unobtainium" in states[bad].message and states[bad].tries == 1
    good = type(sweep)(sweep.folder, sweep.points[:-1], sweep.foresights[:-1], sweep.each, None)
    lost = check_journal(good, killer.killed)
    print(f"{len(killer.killed)} workers killed, {lost} tries lost, {len(killer.runs)} runs died with them")
    assert lost >= 3 and len(killer.runs) >= 3
    for pid in killer.runs:
        assert not os.path.exists(f"/proc/{pid}")
    check_bits(good)
