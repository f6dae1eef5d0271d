"""Stress–strain curves as labs store them: text, .mat of both kinds, .npz; branch, specimen, and what is refused."""

import warnings

import h5py
import numpy as np
import pytest
import scipy.io

import opfem as op

STRAIN = np.linspace(0.0, 0.4, 41)
STRESS = 6.0 * STRAIN + 8.0 * STRAIN**2  # kPa
AREA, HEIGHT = 283.0, 5.51


def check(curve, strain=STRAIN, stress=STRESS):
    np.testing.assert_allclose(curve.stretch, 1.0 - strain, rtol=1e-12)
    np.testing.assert_allclose(curve.nominal, -1e-3 * stress, rtol=1e-12, atol=1e-15)


def test_load_frame_text_with_its_own_specimen(tmp_path):
    """Strain positive, stress negative, no header, rest before the ramp, four rows a step; columns 3 and 4 checked."""
    strain = np.repeat(STRAIN, 4)
    strain = np.concatenate([np.zeros(200), strain])
    stress = 6.0 * strain + 8.0 * strain**2 + 0.16
    table = np.stack([100 * strain, -stress, 20.0 - HEIGHT * strain, -1e-3 * stress * AREA], axis=1)
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", fmt="%.9f")
    curve = op.read_stress_strain(tmp_path / "a.csv")
    assert curve.stretch.size == 158  # of the last step the first row: what follows holds
    np.testing.assert_allclose(
        curve.nominal, -1e-3 * (6.0 * (1 - curve.stretch) + 8.0 * (1 - curve.stretch) ** 2 + 0.16), atol=1e-11
    )
    assert float(curve.area) == pytest.approx(AREA, rel=1e-5)
    assert float(curve.height) == pytest.approx(HEIGHT, rel=1e-5)
    with pytest.warns(op.MeasurementWarning, match="area = 283 mm², area=201"):
        op.read_stress_strain(tmp_path / "a.csv", area=201.0, height=HEIGHT)


@pytest.mark.parametrize(
    "text",
    [
        "Strain (%);Stress (kPa)\n"
        + "\n".join(f"{100 * e:.6f};{s:.6f}".replace(".", ",") for e, s in zip(STRAIN, STRESS, strict=True)),
        "# made by hand\nstrain\tstress_kPa\n"
        + "\n".join(f"{100 * e:.6f}\t{s:.6f}" for e, s in zip(STRAIN, STRESS, strict=True)),
        "\n".join(f"{-100 * e:.6f}, {-s:.6f}" for e, s in zip(STRAIN, STRESS, strict=True)),
    ],
    ids=["semicolons and decimal commas", "tabs", "both negative"],
)
def test_text(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    sign = "auto" if text.startswith("-") else "compression"
    check(op.read_stress_strain(tmp_path / "a.csv", sign=sign))


def test_arrays_by_name(tmp_path):
    np.savez(tmp_path / "a.npz", strain=STRAIN, stress=STRESS, temperature=np.array(21.0))
    scipy.io.savemat(
        tmp_path / "five.mat",
        {"test": {"strain": STRAIN[:, None], "stress_kpa": STRESS[:, None], "tangent_strain": STRAIN}},
    )
    with h5py.File(tmp_path / "seven.mat", "w", userblock_size=512) as file:
        group = file.create_group("test")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, values in (("strain", STRAIN), ("stress_kpa", STRESS)):
            group.create_dataset(name, data=values[None]).attrs["MATLAB_class"] = np.bytes_("double")
    np.save(tmp_path / "a.npy", np.stack([STRAIN, STRESS], axis=1))
    for name in ("a.npz", "five.mat", "seven.mat", "a.npy"):
        check(op.read_stress_strain(tmp_path / name, strain="-", sign="compression"))
    check(op.read_stress_strain(tmp_path / "five.mat", strain="-", sign="compression", variable="test"))
    check(op.read_stress_strain(tmp_path / "a.npz", strain="-", sign="compression", columns=("strain", "stress")))
    with pytest.raises(op.MeasurementError, match=r"stress_kpa.*pass stress='kPa'"):
        op.read_stress_strain(tmp_path / "five.mat", strain="-", stress="MPa", sign="compression")


def test_force_and_displacement(tmp_path):
    table = np.stack([HEIGHT * STRAIN, 1e-3 * AREA * STRESS], axis=1)
    np.save(tmp_path / "a.npy", table)
    check(
        op.read_stress_strain(tmp_path / "a.npy", strain="mm", stress="N", area=AREA, height=HEIGHT, sign="compression")
    )
    with pytest.raises(op.MeasurementError, match="height="):
        op.read_stress_strain(tmp_path / "a.npy", strain="mm", stress="N", area=AREA)


def test_true_stress_and_log_strain(tmp_path):
    stretch = 1.0 + STRAIN
    np.save(tmp_path / "a.npy", np.stack([np.log(stretch), STRESS * stretch], axis=1))
    curve = op.read_stress_strain(tmp_path / "a.npy", strain="log", kind="true", sign="tension")
    np.testing.assert_allclose(curve.stretch, stretch, rtol=1e-12)
    np.testing.assert_allclose(curve.nominal, 1e-3 * STRESS, atol=1e-15)


@pytest.mark.parametrize("branch", ["loading", "unloading", "mean"])
def test_branches_of_a_cycle(tmp_path, branch):
    strain = np.concatenate([STRAIN, STRAIN[-2::-1]])
    back = np.arange(strain.size) >= STRAIN.size
    stress = np.where(back, 0.8, 1.0) * (6.0 * strain + 8.0 * strain**2)
    time = 0.1 * np.arange(strain.size)
    np.save(tmp_path / "a.npy", np.stack([strain, stress, 20 - strain, stress, time], axis=1))
    curve = op.read_stress_strain(
        tmp_path / "a.npy", strain="-", sign="compression", branch=branch, columns=(0, 1, 2, 3, 4)
    )
    factor = {"loading": 1.0, "unloading": 0.8, "mean": 0.9}[branch]
    e = 1.0 - np.asarray(curve.stretch)
    inner = e < 0.4 - 1e-9
    np.testing.assert_allclose(
        np.asarray(curve.nominal)[inner], -1e-3 * factor * (6 * e + 8 * e**2)[inner], rtol=2e-3, atol=1e-9
    )
    assert float(curve.energy_loss) == pytest.approx(0.2, abs=0.02)
    assert float(curve.rate) == pytest.approx(0.1, rel=1e-9)


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("0,0\n10,1\n20,2\n", {}, 'pass sign="compression" or sign="tension"'),
        ("0,0\n0.1,-1\n0.2,-2\n", {}, 'is it a fraction\\? Pass strain="1"'),
        ("0,0\n10,-1\n20,-2\n", {"strain": "-"}, 'Pass strain="%"'),
        ("0,0\n10,-1\nx,-2\n30,-3\n", {}, "line 3, column 1: 'x' is not a number"),
        ("0,0\n10,-1\n,-2\n30,-3\n", {}, "line 3, column 1: has no number"),
        ("0,0\n10,-1\n", {}, "2 rows of numbers"),
        ("0,0\n10,-1\n120,-2\n", {}, "compressed by 120%"),
        ("0,0\n10,-1\n20,-2\n", {"columns": (0, 3)}, "no column 3; it has 2 columns"),
        ("0,0\n10,-1\n20,-2\n", {"branch": "unloading"}, "needs rows that unload"),
        ("0,0\n10,-1\n20,-2\n", {"stress": "bar"}, "stress must be one of Pa, kPa, MPa, N"),
    ],
)
def test_what_is_refused(tmp_path, text, options, message):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(op.MeasurementError, match=message) as caught:
        op.read_stress_strain(tmp_path / "a.csv", **options)
    assert "a.csv" in str(caught.value)


def test_published_curve(shared):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        curve = op.read_stress_strain(shared / "data/silpuran_stress_strain.mat", strain="-", sign="compression")
    strain = 1.0 - np.asarray(curve.stretch)
    np.testing.assert_allclose(
        -1e3 * np.asarray(curve.nominal), -3.252 * np.exp(-1.824 * strain) + 3.173 * np.exp(3.881 * strain), atol=5e-3
    )
