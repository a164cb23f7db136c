"""Jobs run here or on Ray; what is lost runs again, what fails is reported by name."""

import builtins
import os
import pathlib
import threading
import time

import pytest

from physxnet_jax.errors import PhysXNetError
from physxnet_jax.jobs import Job, run_jobs


def square(x):
    return x * x


def wait(x, folder):
    """Leaves a mark when it begins: its number and its machine."""
    import ray

    machine = ray.get_runtime_context().get_node_id()
    (pathlib.Path(folder) / f"{x}-{machine}-{time.monotonic_ns()}").write_text("")
    time.sleep(2.0)
    return x


def fail(x):
    raise ArithmeticError(f"no {x}")


def fail_once(path):
    if not os.path.exists(path):
        pathlib.Path(path).write_text("")
        raise ArithmeticError("once")
    return "second"


def threads():
    return os.environ.get("NPROC")


@pytest.fixture(scope="module")
def cluster():
    """Two machines of one core each, on this one."""
    pytest.importorskip("ray", reason="Ray isn't installed: pip install 'physxnet-jax[cluster]'")
    import ray
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    made.add_node(num_cpus=1)
    ray.init(made.address, log_to_driver=False, runtime_env={"working_dir": None})
    yield made
    ray.shutdown()
    made.shutdown()


def test_jobs_run_in_order_here():
    seen = []
    jobs = [Job(str(k), square, (k,)) for k in range(3)]
    out = list(run_jobs(jobs, report=lambda *x: seen.append(x)))
    assert [(job.name, value) for job, value in out] == [("0", 0), ("1", 1), ("2", 4)]
    assert seen == [("0", 0, 3), ("1", 1, 3), ("2", 2, 3), ("done", 3, 3)]
    with pytest.raises(ArithmeticError, match="no 1"):
        list(run_jobs([Job("a", fail, (1,))]))


def test_missing_ray_is_reported(monkeypatch):
    real = builtins.__import__

    def refuse(name, *rest):
        if name == "ray":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(PhysXNetError, match=r"physxnet-jax\[cluster\]"):
        list(run_jobs([Job("a", square, (1,))], ray="local"))


@pytest.mark.release
def test_jobs_on_a_cluster_report_those_that_fail_twice(cluster, tmp_path):
    jobs = [Job(f"job {k}", square, (k,)) for k in range(4)]
    jobs += [Job("bad", fail, (7,)), Job("shaky", fail_once, (str(tmp_path / "mark"),))]
    got = {}
    with pytest.raises(PhysXNetError, match=r"1 of 7 jobs failed twice.*\n *bad: .*no 7"):
        for job, value in run_jobs([*jobs, Job("threads", threads)], ray=cluster.address):
            got[job.name] = value
    assert got == {f"job {k}": k * k for k in range(4)} | {"shaky": "second", "threads": "1"}


@pytest.mark.release
def test_jobs_of_a_lost_machine_run_again(cluster, tmp_path):
    node = cluster.add_node(num_cpus=2)
    jobs = [Job(str(k), wait, (k, str(tmp_path))) for k in range(6)]

    def remove_once_it_works():
        while not list(tmp_path.glob(f"*-{node.node_id}-*")):
            time.sleep(0.05)
        cluster.remove_node(node, allow_graceful=False)

    remover = threading.Thread(target=remove_once_it_works)
    remover.start()
    out = [(job.name, value) for job, value in run_jobs(jobs, ray=cluster.address)]
    remover.join()
    assert sorted(out) == [(str(k), k) for k in range(6)]
    begun = [p.name.split("-")[0] for p in tmp_path.iterdir()]
    assert len(begun) > 6 and set(begun) == set("012345"), "some began again"
