"""CalculiX' results on opfem's grid, and the round trip through `ccx` where it is installed."""

import os
import shutil
import subprocess

import numpy as np
import pytest

import opfem as op
from tests.decks.test_writing import soft
from tests.experiments import bumpy_map, inclusion_experiment, published_palpation
from tests.tolerances import OTHER_CODE

PRESCRIBED = published_palpation(window=op.Bonded(), sample=op.Bonded(), element="full")
UZ = np.asarray(-0.04 - 0.02 * np.outer(np.hanning(7), np.hanning(7)))
SIX_DIGITS = 1e-4  # of results that a .frd file has to 6 digits, after a derivative


def frd(nodes, blocks) -> str:
    """A .frd file as its description has it: fixed columns, six numbers a line.

    Source:
        CalculiX GraphiX manual, "Result Format": (I3, I10, 6E12.5), long form.
    """
    lines = ["    1C", "    1UUSER", f"    2C{len(nodes):>30}{1:>38}"]
    lines += [f" -1{n:10d}" + "".join(f"{value:12.5E}" for value in X) for n, X in nodes.items()]
    lines += [" -3", f"    3C{1:>30}{1:>38}", f" -1{1:10d}{1:5d}{0:5d}{1:5d}", f" -2{1:10d}", " -3"]
    for time, name, words, values in blocks:
        stored = [word for word in words if word != "ALL"]
        lines += [
            f"    1PSTEP{1:>26}{1:>12}{1:>12}",
            f"  100CL  101{time:12.9f}{len(values):12d}{'':20}{0:2d}{1:5d}{'':10}{1:2d}",
        ]
        lines.append(f" -4  {name:8}{len(words):5d}{1:5d}")
        lines += [f" -5  {word:8}{1:5d}{2:5d}{k:5d}{0:5d}{int(word == 'ALL'):5d}" for k, word in enumerate(words, 1)]
        for n, row in values.items():
            assert len(row) == len(stored)
            for first in range(0, len(row), 6):
                start = f" -1{n:10d}" if first == 0 else " -2" + " " * 10
                lines.append(start + "".join(f"{value:12.5E}" for value in row[first : first + 6]))
        lines.append(" -3")
    return "\n".join([*lines, " 9999", ""])


def numbered(X, first=1):
    """Number nodes in another order than opfem's, with gaps."""
    points = X.reshape(3, -1).T
    order = np.random.default_rng(1).permutation(len(points))
    return {first + 3 * int(k): points[k] for k in order}


@pytest.fixture(scope="module")
def solved():
    return op.solve(PRESCRIBED, op.Displacement(UZ, "fixed"))


def test_fields_are_those_of_the_solution_that_was_written(tmp_path, solved):
    """A solution of `element="full"`, which is CalculiX' C3D8, written as CalculiX would: the same tractions."""
    X, u = np.asarray(solved.positions), np.asarray(solved.displacement)
    nodes = numbered(X)
    points = {number: k for k, number in enumerate(sorted(nodes))}
    moves = {n: u.reshape(3, -1).T[points[n]] for n in nodes}
    half = {n: 0.5 * row for n, row in moves.items()}
    strange = {900_001: np.array([50.0, 50.0, 50.0])}
    words = ["D1", "D2", "D3", "ALL"]
    stress = {n: [1.0, 2.0, 3.0, 4.0, 5.0, 6.0] for n in nodes}
    blocks = [
        (0.5, "DISP", words, {**half, 900_001: np.zeros(3)}), (0.5, "STRESS", ["SXX"] * 6, stress),
        (1.0, "DISP", words, {**moves, 900_001: np.zeros(3)}), (1.0, "STRESS", ["SXX"] * 6, stress),
    ]  # fmt: skip
    (tmp_path / "job.frd").write_text(frd(nodes | strange, blocks))
    data = op.read_frd(tmp_path / "job.frd", PRESCRIBED)
    assert data.time.values.tolist() == [0.5, 1.0]
    last, expected = data.isel(time=-1), op.to_xarray(solved)
    assert last.displacement.dims == expected.displacement.dims
    np.testing.assert_allclose(last.displacement, expected.displacement, atol=1e-6)
    np.testing.assert_allclose(data.displacement[0], 0.5 * expected.displacement, atol=1e-6)
    scale = float(np.abs(expected.traction).max())
    np.testing.assert_allclose(last.traction, expected.traction, atol=SIX_DIGITS * scale)
    np.testing.assert_allclose(last.force_sample, expected.force_sample, atol=SIX_DIGITS * 0.1)
    np.testing.assert_allclose(last.pressure[1:-1, 1:-1], expected.pressure[1:-1, 1:-1], rtol=0.03)
    np.testing.assert_array_equal(last.stress[:, :, 0, 0, 0], [[1, 4, 6], [4, 2, 5], [6, 5, 3]])


def test_sample_of_an_experiment(tmp_path):
    experiment = inclusion_experiment()
    X, Y = np.array(experiment.layer_mesh().positions()), np.array(experiment.sample_mesh().positions())
    Y[2] += 0.01  # where its deck has it, at the law's clearance
    nodes = {**numbered(X), **numbered(Y, first=100_000)}
    (tmp_path / "job.frd").write_text(
        frd(nodes, [(1.0, "DISP", ["D1", "D2", "D3"], {n: 1e-3 * x for n, x in nodes.items()})])
    )
    data = op.read_frd(tmp_path / "job.frd", experiment)
    np.testing.assert_allclose(data.displacement[0], 1e-3 * X, atol=1e-8)
    np.testing.assert_allclose(data.sample_displacement[0], 1e-3 * Y, atol=1e-8)


DAT = """
 total force (fx,fy,fz) for set NIMP and time  0.1000000E+01

       -1.000000E-03  2.000000E-03 -2.352100E-01

 stresses (elem, integ.pnt.,sxx,syy,szz,sxy,sxz,syz) for set LAYER_HIGH and time  0.1000000E+01

"""


def test_printed_forces_and_stresses(tmp_path):
    rows = [
        f"{37 + e:10d}{p + 1:4d}  0.0 0.0 {-0.01 * e - 0.001 * p:.6E} 0.0 0.0 0.0" for e in range(36) for p in range(8)
    ]
    (tmp_path / "job.dat").write_text(DAT + "\n".join(rows) + "\n")
    data = op.read_dat(tmp_path / "job.dat", PRESCRIBED)
    np.testing.assert_allclose(data.force_nimp.isel(time=0), [-1e-3, 2e-3, -0.23521])
    expected = -0.01 * np.arange(36).reshape(6, 6) - 0.0035
    np.testing.assert_allclose(data.stress_zz[0], expected, atol=1e-9)


WRONG = {
    "binary": ("job.frd", "garbage", "no nodes: is it a .frd file in ASCII"),
    "no displacement": ("job.frd", frd({1: np.zeros(3)}, []), "has no node at"),
    "words": ("job.frd", frd({1: np.zeros(3)}, []).replace("0.00000E+00", "0.0000x", 1), "job.frd:4: expected"),
    "empty": ("job.dat", "\n", "no total force and no stresses"),
    "ragged": ("job.dat", DAT + "1 1 0. 0. 0. 0. 0. 0.\n1 2 0.\n", "job.dat:9: the table of stresses has a line of 3"),
}  # fmt: skip


@pytest.mark.parametrize("what", WRONG)
def test_wrong_results_are_refused(tmp_path, what):
    name, content, words = WRONG[what]
    (tmp_path / name).write_text(content)
    with pytest.raises(op.DeckError, match=words):
        (op.read_frd if name.endswith("frd") else op.read_dat)(tmp_path / name, PRESCRIBED)


needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed (Debian: calculix-ccx)")


def through_ccx(folder, palpation, load):
    """Write, solve with ccx, read."""
    op.write_inp(folder / "job.inp", palpation, load, op.Newton(increments=10), code="calculix")
    environment = {"OMP_NUM_THREADS": "1", **os.environ}
    subprocess.run(["ccx", "-i", "job"], cwd=folder, env=environment, check=True, capture_output=True, timeout=600)
    return op.read_frd(folder / "job.frd", palpation).isel(time=-1), op.read_dat(folder / "job.dat", palpation).isel(
        time=-1
    )


@needs_ccx
def test_round_trip_of_prescribed_displacement(tmp_path, solved):
    fields, printed = through_ccx(tmp_path, PRESCRIBED, op.Displacement(UZ, "fixed"))
    force = float(solved.stats["force_sample"][2])
    assert float(fields.force_sample[2]) == pytest.approx(force, rel=1e-3)
    np.testing.assert_allclose(printed.stress_zz, solved.stress_zz, rtol=OTHER_CODE)


@needs_ccx
def test_round_trip_of_contact(tmp_path):
    """Facets against a smooth surface: 2 % of the force."""
    palpation = published_palpation(window=soft(10.0, 0.15, 0.1), sample=soft(10.0, 0.05, 0.02), element="full")
    load = op.Imprint(bumpy_map())
    _, printed = through_ccx(tmp_path, palpation, load)
    force = float(op.solve(palpation, load).stats["force_sample"][2])
    assert float(printed.force_press[2]) == pytest.approx(force, rel=0.02)
