"""The processes that a study starts on this machine, as Dask's own classes would begin and end."""

from unittest.mock import MagicMock

import pytest

from inspe_jax.core.errors import InspeError

cluster = pytest.importorskip("inspe_jax.jobs.cluster")


@pytest.fixture
def dask(monkeypatch):
    """Dask's classes: a cluster and a client that take longer to end than Dask waits."""
    made = MagicMock()
    made.LocalCluster.return_value.close.side_effect = TimeoutError
    client = made.Client.return_value.__enter__.return_value = made.Client.return_value
    client.__exit__.return_value = False
    client.wait_for_workers.side_effect = TimeoutError
    for name in ("LocalCluster", "Client"):
        monkeypatch.setattr(cluster, name, getattr(made, name))
    return made


def test_a_cluster_that_is_slow_to_end_loses_nothing(dask):
    with cluster.client(None, 2) as here:
        assert here is dask.Client.return_value
    assert dask.LocalCluster.call_args.kwargs["n_workers"] == 2
    dask.LocalCluster.return_value.adapt.assert_called_with(minimum=2, maximum=2, interval="1s")
    dask.LocalCluster.return_value.close.assert_called_once()
    with pytest.raises(TimeoutError, match="of the work"), cluster.client(None, 2):
        raise TimeoutError("of the work")


@pytest.mark.parametrize("late", ["LocalCluster", "Client"])
def test_a_cluster_that_does_not_start_says_so(dask, late):
    getattr(dask, late).side_effect = TimeoutError
    wrong = pytest.raises(InspeError, match="3 worker processes did not start in time")
    with wrong, cluster.client(None, 3):
        pass
