"""Displacement volumes in files: nothing changes on the way, and what is none is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op


@pytest.fixture
def volume():
    rng = np.random.default_rng(0)
    shape = (3, 4, 5)
    values, std, coherence = rng.standard_normal(shape), rng.random(shape), rng.random(shape)
    return op.DisplacementVolume(
        values, std, coherence, rng.random(shape) < 0.3, np.arange(5.0), jnp.array([0.1, 0.2]), jnp.array([1.0, 2.0]),
        jnp.array(0.01), jnp.array([0.03, 0.04]), jnp.array(2.5), (),
    )  # fmt: skip


def test_a_file_holds_the_whole_volume(volume, tmp_path):
    op.write_displacement(volume, tmp_path / "d.npz")
    again = op.read_displacement(tmp_path / "d.npz")
    for name in vars(volume):
        np.testing.assert_array_equal(getattr(again, name), getattr(volume, name), err_msg=name)


def test_what_is_no_displacement_is_refused(volume, tmp_path):
    with pytest.raises(op.MeasurementError, match="no such file"):
        op.read_displacement(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("text")
    with pytest.raises(op.MeasurementError, match="damaged or of another kind"):
        op.read_displacement(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    with pytest.raises(op.MeasurementError, match="lacks std, coherence"):
        op.read_displacement(tmp_path / "other.npz")
    np.savez(tmp_path / "objects.npz", values=np.array([None]))
    with pytest.raises(op.MeasurementError, match="damaged or of another kind"):
        op.read_displacement(tmp_path / "objects.npz")
    stored = {name: np.asarray(getattr(volume, name)) for name in vars(volume) if name != "steps"}
    np.savez(tmp_path / "flat.npz", **{**stored, "values": np.zeros((3, 4))})
    with pytest.raises(op.MeasurementError, match=r"got shapes \(3, 4\)"):
        op.read_displacement(tmp_path / "flat.npz")
