"""Stress, strain and energy inside the layer against uniform states, linear fields and the solve's own sums."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.oracles import cauchy_stress
from tests.tolerances import ROUNDOFF

C10, C01, BULK = 2.23e-3, 7.03e-4, 0.11732  # of the fixture `solution`


@pytest.fixture(scope="module")
def fields(solution):
    return op.layer_fields(solution)


def with_displacement(solution, u):
    return eqx.tree_at(lambda s: s.displacement, solution, u)


def with_palpation(solution, thickness=0.5, element="mean_dilatation"):
    given = solution.palpation
    layer = op.Layer(thickness, given.layer.material)
    palpation = op.Palpation(layer, (2.0, 2.0), given.elements, given.window, given.sample, element=element)
    return eqx.tree_at(lambda s: s.palpation, solution, palpation)


@pytest.mark.parametrize("element", ["mean_dilatation", "full", "reduced", "tet4", "tet10"])
def test_uniform_deformation(solution, element):
    H = np.array([[0.1, 0.2, -0.05], [0.0, -0.2, 0.1], [0.15, 0.0, -0.3]])
    F = np.eye(3) + H
    u = jnp.tensordot(jnp.asarray(H), solution.positions, axes=1)
    fields = op.layer_fields(with_displacement(with_palpation(solution, element=element), u))
    for got, expected in (
        (fields.stress, cauchy_stress(F, C10, C01, BULK)),
        (fields.deformation_gradient, F),
        (fields.green_strain, 0.5 * (F.T @ F - np.eye(3))),
    ):
        whole = np.broadcast_to(expected[:, :, None, None, None, None], got.shape)
        np.testing.assert_allclose(got, whole, ROUNDOFF, ROUNDOFF)
        nodal = np.asarray(fields.at_nodes(got))
        np.testing.assert_allclose(
            nodal, np.broadcast_to(expected[:, :, None, None, None], nodal.shape), ROUNDOFF, ROUNDOFF
        )


def test_a_linear_field_is_recovered_exactly_up_to_the_surfaces(solution):
    """Position itself, taken at the Gauss points of a warped layer."""
    L0 = op.ThicknessMap(0.5 + 0.1 * np.random.default_rng(0).uniform(size=(7, 7)), extent=(2.0, 2.0))
    warped = with_palpation(solution, thickness=L0)
    X = warped.palpation.mesh().positions()
    fields = op.layer_fields(warped)
    low = 0.5 - 0.5 / np.sqrt(3.0)
    linear = [np.array([[1 - t, t] for t in (low, 1 - low)])] * 3
    nz, ny, nx = (n - 1 for n in X.shape[1:])
    cells = np.stack(
        [X[:, z : z + nz, y : y + ny, x : x + nx] for z in (0, 1) for y in (0, 1) for x in (0, 1)], axis=1
    ).reshape(3, 2, 2, 2, nz, ny, nx)
    at_points = np.einsum("ca,db,eg,iabgkjl->icdekjl", linear[0], linear[1], linear[2], cells)
    np.testing.assert_allclose(fields.at_nodes(jnp.asarray(at_points.reshape(3, 8, nz, ny, nx))), X, ROUNDOFF, ROUNDOFF)


@pytest.mark.parametrize("element", ["tet4", "tet10"])
def test_a_linear_field_is_recovered_exactly_from_tetrahedra(solution, element):
    """Position itself, at the points of a flat layer; the centroids of an element's six tetrahedra lie in a plane."""
    flat = with_palpation(solution, element=element)
    X = flat.palpation.mesh().positions()
    fields = op.layer_fields(flat)
    kind = fields.cells.kind
    first = np.stack([np.asarray(x)[(slice(None, -1, kind.span),) * 3] for x in X])
    size = np.array([2.0 / 6, 2.0 / 6, 0.5 / 2]) * kind.span
    at_points = first[:, None] + (size * kind.points).T[:, :, None, None, None]
    known = (slice(None), *[slice(1, -1) if element == "tet4" else slice(None)] * 3)
    np.testing.assert_allclose(fields.at_nodes(jnp.asarray(at_points))[known], X[known], ROUNDOFF, ROUNDOFF)
    assert fields.element_mean(fields.stress).shape == (3, 3, 2, 6, 6)


def test_sums_are_the_solves_own(solution, fields):
    energy = jnp.sum(fields.energy_density * fields.volume)
    np.testing.assert_allclose(energy, solution.stats["strain_energy"], ROUNDOFF)
    np.testing.assert_allclose(fields.element_mean(fields.stress)[2, 2, -1], solution.stress_zz, ROUNDOFF)


def test_recovered_surface_stress_balances_the_contact_pressure(solution, fields):
    """Away from the rim the recovered stress at the interface is nearer to the pressure than the element mean."""
    inner = (slice(2, -2), slice(2, -2))
    recovered = -fields.at_nodes(fields.stress)[2, 2, -1][inner]
    mean = -np.asarray(solution.stress_zz)
    mean = 0.25 * (mean[1:, 1:] + mean[1:, :-1] + mean[:-1, 1:] + mean[:-1, :-1])[1:-1, 1:-1]
    pressure = np.asarray(solution.pressure)[inner]
    assert np.abs(recovered - pressure).max() < 0.1 * pressure.max()
    assert np.abs(recovered - pressure).max() < np.abs(mean - pressure).max()


def test_derivatives_and_failed_solutions(solution, failed_solution):
    def energy(scale):
        fields = op.layer_fields(with_displacement(solution, scale * solution.displacement))
        return jnp.sum(fields.energy_density * fields.volume)

    slope = jax.jit(jax.grad(energy))(1.0)
    difference = (energy(1.0 + 1e-5) - energy(1.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, difference, 1e-7)
    assert np.isnan(op.layer_fields(failed_solution).stress).all()


def test_dataset_and_paraview(solution, fields, tmp_path):
    import pyvista

    data = op.to_xarray(solution, interior=True)
    stress = np.asarray(fields.at_nodes(fields.stress))
    np.testing.assert_array_equal(data.stress.sel(component="z", direction="x"), stress[2, 0])
    assert "stress" not in op.to_xarray(solution)
    op.write_vtu(data, tmp_path / "layer.vtu")
    grid = pyvista.read(tmp_path / "layer.vtu")
    np.testing.assert_allclose(grid["stress_MPa"][:, 8], stress[2, 2].ravel())
    op.write_netcdf(data, tmp_path / "layer.nc")
    np.testing.assert_array_equal(op.read_netcdf(tmp_path / "layer.nc").energy_density, data.energy_density)
