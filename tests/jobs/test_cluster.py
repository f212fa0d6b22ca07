"""The processes that a study starts on this machine, as Dask's own classes would begin and end."""

import pytest

from inspe_jax.core.errors import InspeError

cluster = pytest.importorskip("inspe_jax.jobs.cluster")


class Cluster:
    """Ends later than Dask waits for it."""

    ended = False

    def __init__(self, **given):
        self.count = given["n_workers"]

    def adapt(self, **given):
        assert given["minimum"] == given["maximum"] == self.count

    def close(self):
        Cluster.ended = True
        raise TimeoutError


class Client:
    def __init__(self, of):
        self.of = of

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def register_plugin(self, plugin):
        pass

    def wait_for_workers(self, count, timeout):
        raise TimeoutError


def test_a_cluster_that_is_slow_to_end_loses_nothing(monkeypatch):
    monkeypatch.setattr(cluster, "LocalCluster", Cluster)
    monkeypatch.setattr(cluster, "Client", Client)
    with cluster.client(None, 2) as here:
        assert here.of.count == 2
    assert Cluster.ended
    with pytest.raises(TimeoutError, match="of the work"), cluster.client(None, 2):
        raise TimeoutError("of the work")


@pytest.mark.parametrize("late", ["LocalCluster", "Client"])
def test_a_cluster_that_does_not_start_says_so(monkeypatch, late):
    def never(*given, **options):
        raise TimeoutError

    monkeypatch.setattr(cluster, "LocalCluster", Cluster)
    monkeypatch.setattr(cluster, "Client", Client)
    monkeypatch.setattr(cluster, late, never)
    wrong = pytest.raises(InspeError, match="3 worker processes did not start in time")
    with wrong, cluster.client(None, 3):
        pass
