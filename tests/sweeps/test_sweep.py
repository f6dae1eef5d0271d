"""`op.sweep` on functions that are known in closed form: values, labels, failures, batches."""

import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import opfem as op
from opfem.solvers import CONVERGED
from opfem.solvers.progress import Progress
from opfem.sweeps.outputs import GOOD
from opfem.sweeps.progress import SweepProgress
from opfem.sweeps.store import Outcome
from tests.tolerances import ROUNDOFF

MODES = ("map", "vmap", "call")
AXES = {"force": [1.0, 2.0, -3.0], "distance": [3.0, 4.0]}


def work(force, distance):
    return {"work": force * distance, "field": force * jnp.arange(6.0).reshape(2, 3)}


def same(a: xr.Dataset, b: xr.Dataset) -> bool:
    return a.drop_vars("wall_time").drop_attrs().identical(b.drop_vars("wall_time").drop_attrs())


def test_a_solve_that_kept_its_fields_has_a_result_in_a_sweep():
    assert set(GOOD) == set(CONVERGED)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("size", [1, 4, 6, 100])
def test_a_table_holds_what_the_loop_gives(mode, size):
    data = op.sweep(work, AXES, execution=op.Batch(size, mode))
    assert data.work.dims == ("force", "distance")
    for force in AXES["force"]:
        for distance in AXES["distance"]:
            point = data.sel(force=force, distance=distance)
            assert float(point.work) == force * distance
            np.testing.assert_array_equal(point.field, force * np.arange(6.0).reshape(2, 3))
    assert (data.status == "successful").all()
    assert (data.wall_time > 0).all()


def test_units_and_names():
    data = op.sweep(work, AXES, units={"work": "N mm", "force": "N"})
    assert data.work.attrs["units"] == "N mm"
    assert data.force.attrs["units"] == "N"
    assert data.wall_time.attrs["units"] == "s"
    assert "units" not in data.distance.attrs
    with pytest.raises(ValueError, match="axis or output must be one of force, distance, work, field, got 'wrok'"):
        op.sweep(work, AXES, units={"wrok": "N mm"})
    assert set(op.sweep(lambda a: 2 * a, {"a": [1.0]}).data_vars) == {"status", "message", "wall_time", "value"}
    with pytest.raises(ValueError, match="cannot be called 'a': that name is taken"):
        op.sweep(lambda a: {"a": a}, {"a": [1.0]}, execution=op.Batch(mode="call"))


def test_points_without_a_grid():
    data = op.sweep(work, op.zip_({"force": [1.0, 2.0], "distance": [3.0, 5.0]}))
    np.testing.assert_array_equal(data.work, [3.0, 10.0])
    np.testing.assert_array_equal(data.force, [1.0, 2.0])
    assert data.force.dims == data.work.dims == ("point",)


def test_keep_may_be_a_function():
    data = op.sweep(work, AXES, keep=lambda answer: {"mean": answer["field"].mean()})
    np.testing.assert_allclose(data["mean"].sel(distance=3.0), 2.5 * np.array(AXES["force"]), rtol=ROUNDOFF)
    assert "work" not in data


@pytest.mark.parametrize("mode", MODES)
def test_failures_are_marked_and_stop_no_other(mode):
    def root(a):
        a = jnp.asarray(a)
        return {"root": eqx.error_if(jnp.sqrt(a), a > 5, "too large for me"), "twice": 2 * a}

    data = op.sweep(root, {"a": [1.0, -1.0, 9.0, 4.0]}, execution=op.Batch(4 if mode != "call" else 1, mode))
    assert data.status.values.tolist() == ["successful", "nonfinite", "error", "successful"]
    np.testing.assert_array_equal(data.root, [1.0, np.nan, np.nan, 2.0])
    np.testing.assert_array_equal(data.twice, [2.0, np.nan, np.nan, 8.0])
    assert data.message.values[0] == ""
    assert "root" in data.message.values[1]
    assert "too large for me" in data.message.values[2]


def test_a_map_with_some_missing_pixels_is_no_failure():
    data = op.sweep(lambda a: {"map": jnp.array([a, jnp.nan])}, {"a": [1.0]})
    assert data.status.item() == "successful"


def test_a_function_that_always_raises_says_so():
    def broken(a):
        return {}[str(float(a))]

    with pytest.raises(RuntimeError, match=r"broken raised at every point.*KeyError"):
        op.sweep(broken, {"a": [1.0, 2.0]})


def test_a_mistake_is_found_while_tracing():
    def wrong(a):
        return jnp.ones(3) @ jnp.ones(4) * a

    with pytest.raises(TypeError, match="dot_general"):
        op.sweep(wrong, {"a": [1.0]})
    for mode in ("auto", "call"):
        with pytest.raises(ValueError, match="must return a number, an array"):
            op.sweep(lambda a: [a], {"a": [1.0]}, execution=op.Batch(mode=mode))


def test_what_cannot_be_traced_is_called():
    def count(n, word):
        return np.zeros(n).size * len(word)

    data = op.sweep(count, {"n": [1, 2, 3], "word": ["a", "bb"]})
    np.testing.assert_array_equal(data["count"], [[1, 2], [2, 4], [3, 6]])
    data = op.sweep(lambda a: float(a) ** 2, {"a": [1.0, 3.0]})
    np.testing.assert_array_equal(data["value"], [1.0, 9.0])
    with pytest.raises(jax.errors.JAXTypeError):
        op.sweep(lambda a: float(a) ** 2, {"a": [1.0, 3.0]}, execution=op.Batch(mode="map"))


def test_outputs_of_another_shape_are_marked():
    data = op.sweep(lambda n: {"ones": np.ones(n), "sum": float(n)}, {"n": [2, 3]})
    assert data.status.values.tolist() == ["successful", "error"]
    assert "ones has shape (3,), elsewhere (2,)" in data.message.values[1]
    np.testing.assert_array_equal(data["sum"], [2.0, 3.0])


def test_easy_points_do_not_wait_for_a_hard_one():
    released = threading.Event()

    def wait(number):
        if number == 0:
            released.wait(20)  # until all others are done
            return 0.0
        if number == 9:
            released.set()
        return float(number)

    data = op.sweep(wait, {"number": np.arange(10)}, execution=op.Batch(mode="call", threads=2))
    np.testing.assert_array_equal(data["wait"], np.arange(10.0))
    assert released.is_set()


def test_a_batch_does_not_suffer_from_a_hard_lane():
    """Each lane's loop ends by itself: the bits are those that it has alone."""

    def halvings(start):
        return jax.lax.while_loop(lambda c: c[0] > 1e-3, lambda c: (0.5 * c[0], c[1] + 1), (start, 0))

    def counted(start):
        value, count = halvings(start)
        return {"left": value, "steps": count}

    axes = {"start": [1.0, 1e6, 1e-6, 1e3]}
    assert same(
        op.sweep(counted, axes, execution=op.Batch(4, "vmap")), op.sweep(counted, axes, execution=op.Batch(1, "map"))
    )


def test_wrong_execution():
    with pytest.raises(ValueError, match=r"Batch.size must be a whole number of at least 1, or None, got 0"):
        op.Batch(0)
    with pytest.raises(ValueError, match=r"Batch.mode must be one of .*got 'pmap'"):
        op.Batch(mode="pmap")
    with pytest.raises(ValueError, match=r"Batch.threads must be"):
        op.Batch(threads=-1)
    with pytest.raises(ValueError, match=r"Devices.mode must be .*got \"call\""):
        op.Devices(mode="call")
    with pytest.raises(ValueError, match=r"Cluster.client must be a dask.distributed.Client, got str"):
        op.Cluster("tcp://somewhere")


def test_one_device_is_all_devices_here():
    assert same(op.sweep(work, AXES, execution=op.Devices()), op.sweep(work, AXES))


def test_progress_says_rate_failures_and_time_left(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    bar = SweepProgress(Progress(False), total=100, finished=40)
    now[0] = 10.0
    for status in 17 * ["successful"] + 3 * ["nonfinite"]:
        bar.finished({}, Outcome(status, "", 0.5, {}, {}))
    assert bar.text() == "2 points/s, 3 failed, 0:20 left"
