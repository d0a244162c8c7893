"""The pool on a cluster of three nodes, which Ray simulates on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from ibrobot_provenance.jobs import Job, open_pool
from ibrobot_provenance.pool_suite import PoolSuite
from ibrobot_ray.pool import RayPool
from ibrobot_testing import LeakCheck
from ibrobot_testing.pool_jobs import Order, square, wait
from ray.cluster_utils import Cluster

from ibrobot_core.app import ComponentFailed

pytestmark = pytest.mark.long
NODES = 3
LOOPBACK = "127.0.0.2"
"""Ray replaces 127.0.0.1 by the address of the network when it connects."""
PATIENCE_S = 240.0


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[Any]:
    """Nodes of one core each, without dashboard, on the loopback."""
    node: dict[str, Any] = {"num_cpus": 1, "include_dashboard": False, "node_ip_address": LOOPBACK}
    found: Any = Cluster()
    with pytest.MonkeyPatch.context() as patched:
        try:
            for _ in range(NODES):
                found.add_node(**node, object_store_memory=80 << 20, include_log_monitor=False)
            patched.setenv("RAY_ADDRESS", found.address)
            yield found
        finally:
            found.shutdown()


LEAKS = LeakCheck(
    allow={
        "thread": "Ray's threads end some time after the connection",
        "file": "Ray keeps its log files and sockets until the process ends",
        "port": "as its files",
    }
)


@pytest.fixture(autouse=True)
def no_leaks() -> Iterator[None]:
    with LEAKS.watch():
        yield


class TestRayPool(PoolSuite):
    leak_check = LEAKS
    patience_s = PATIENCE_S

    def pool(self, jobs):
        return RayPool("", jobs)


def test_jobs_of_a_removed_node_are_run_again(cluster: Any, tmp_path: Path) -> None:
    """All nodes have a job; the one of a node that is removed begins again on another."""
    orders = [Order(number, str(tmp_path)) for number in range(NODES)]
    with closing(open_pool("ray")) as pool:
        running = pool.run([Job(wait, order) for order in orders] + [Job(square, Order(5))], lambda count: step())

        def step() -> None:
            """When all run, remove a node; then let them end."""
            if len(list(tmp_path.glob("began_*"))) == NODES and len(cluster.worker_nodes) == NODES - 1:
                cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
                (tmp_path / "go").touch()

        assert sorted(done.result() for done in running) == [0, 1, 2, 25]
    assert len(cluster.worker_nodes) == NODES - 2


@pytest.mark.filterwarnings("ignore:Ray Client connection timed out")
def test_cluster_that_cannot_be_reached_is_an_error() -> None:
    with pytest.raises(ComponentFailed, match=r"the Ray cluster 127\.0\.0\.1:1 cannot be used"):
        open_pool("ray://127.0.0.1:1")
