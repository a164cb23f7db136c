"""Datasets built on a cluster have the bytes of those built in one process."""

import dataclasses
import threading
import time

import pytest

from physxnet_jax.cli import main
from physxnet_jax.data import DatasetConfig, build_dataset, dataset_digest, read_times
from physxnet_jax.errors import PhysXNetError
from physxnet_jax.simulation import XPBD


@pytest.fixture(scope="module")
def mocap(tmp_path_factory, write_mocap):
    """Four short actions of a built-in clip."""
    actions = [("train", f"part {k}", 0.3 * k, 6 + k) for k in range(4)]
    return write_mocap(tmp_path_factory.mktemp("mocap"), 40, actions)


CONFIG = DatasetConfig(splits=("train",), templates=("bottom",), people=2, solver=XPBD(8, 1))


@pytest.fixture(scope="module")
def plain(mocap, tmp_path_factory):
    """The dataset of one process."""
    root = tmp_path_factory.mktemp("plain")
    assert build_dataset(CONFIG, root, mocap) == 4
    return dataset_digest(root)


@pytest.mark.nightly
def test_dataset_of_a_cluster_that_loses_a_machine_has_the_same_bytes(mocap, plain, tmp_path):
    ray = pytest.importorskip("ray", reason="Ray isn't installed: physxnet-jax[cluster]")
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        ray.init(cluster.address, log_to_driver=False)

        def remove_once_it_works():
            # Both machines have a job; the lost one is in the middle of compiling its program.
            while ray.available_resources().get("CPU", 0.0) > 0.0:
                time.sleep(0.05)
            time.sleep(3.0)
            stored.append(len(read_times(tmp_path)))
            cluster.remove_node(node, allow_graceful=False)

        stored: list[int] = []
        remover = threading.Thread(target=remove_once_it_works)
        remover.start()
        count = build_dataset(CONFIG, tmp_path, mocap, ray=cluster.address)
        remover.join()
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert stored[0] < 4, "it was lost in the middle"
    assert count == 4 and dataset_digest(tmp_path) == plain
    assert sorted(line["action"] for line in read_times(tmp_path)) == [
        f"part {k}" for k in range(4)
    ]


@pytest.mark.release
def test_failing_jobs_are_named_and_the_others_are_stored(mocap, tmp_path, monkeypatch):
    pytest.importorskip("ray", reason="Ray isn't installed: physxnet-jax[cluster]")
    table = (mocap / "ACTIONS.csv").read_text()
    broken = tmp_path / "mocap"
    broken.mkdir()
    (broken / "ACTIONS.csv").write_text(table.replace("part 3,punch.npz", "part 3,gone.npz"))
    (broken / "punch.npz").write_bytes((mocap / "punch.npz").read_bytes())
    config = dataclasses.replace(CONFIG, people=1)
    root = tmp_path / "set"
    with pytest.raises(PhysXNetError, match=r"1 of 4 jobs failed twice(.|\n)*part 3: bottom"):
        build_dataset(config, root, broken, ray="local")
    assert sorted(line["action"] for line in read_times(root)) == ["part 0", "part 1", "part 2"]


@pytest.mark.release
def test_command_builds_on_ray_into_a_url(mocap, plain, tmp_path, capsys):
    pytest.importorskip("ray", reason="Ray isn't installed: physxnet-jax[cluster]")
    (tmp_path / "sets.toml").write_text(
        '[a]\nsplits = ["train"]\ntemplates = ["bottom"]\npeople = 2\n'
        "solver = { substeps = 8, contact_updates = 1 }\n"
    )
    url = f"file://{tmp_path}/set/"
    command = ["dataset", "build", f"{tmp_path}/sets.toml#a", "--out", url, "--ray"]
    assert main([*command, "--mocap", str(mocap)]) == 0
    assert plain[0] in capsys.readouterr().out
    assert main(["dataset", "check", url, "--mocap", str(mocap)]) in (0, 1)
    assert main([*command, "host:1", "host:2"]) == 2
