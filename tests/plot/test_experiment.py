"""Pictures of a virtual experiment: the cross-section, and an estimate beside the truth."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection, QuadMesh

import opfem as op
from opfem.plot import draw_simulation
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(truth):
    return op.to_xarray(truth)


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def meshes(ax):
    return [part for part in ax.collections if isinstance(part, QuadMesh)]


def outlines(ax):
    (lines,) = [part for part in ax.collections if isinstance(part, LineCollection)]
    return np.array(lines.get_segments()).reshape(-1, 2, 2)


def test_both_bodies_are_drawn_where_they_have_moved(dataset, truth):
    ax = op.plot_section(dataset, y=1.0)
    layer, sample = meshes(ax)
    current = np.asarray(truth.sample.positions + truth.sample.displacement)
    middle = 0.5 * (current[:, :, 2] + current[:, :, 3])  # the third of five elements holds y = 1
    np.testing.assert_allclose(sample.get_coordinates()[..., 0], middle[0], rtol=tol.ROUNDOFF, atol=1e-12)
    np.testing.assert_allclose(sample.get_coordinates()[..., 1], middle[2], rtol=tol.ROUNDOFF, atol=1e-12)
    assert layer.get_coordinates().shape == (3, 7, 2)
    np.testing.assert_allclose(sample.get_array(), -1e3 * np.asarray(truth.sample.stress[2, 2, :, 2]))
    assert ax.get_ylim()[0] > 1.3 > 0.0 > ax.get_ylim()[1]  # the window is at the top
    assert ax.get_aspect() == 1


def test_the_inclusion_is_outlined(dataset, truth):
    """Elements of the third row whose shear modulus is the inclusion's: the outline closes around them."""
    ax = op.plot_section(dataset, y=1.0)
    stiff = np.asarray(dataset.sample_shear_modulus)[:, 2] > 0.01
    padded = np.pad(stiff, 1)
    expected = np.sum(padded[1:] != padded[:-1]) + np.sum(padded[:, 1:] != padded[:, :-1])
    assert stiff.any()
    assert len(outlines(ax)) == expected
    assert len(outlines(op.plot_section(dataset, y=0.05))) == 0


def test_von_mises_stress_of_a_uniaxial_one_is_its_size(dataset):
    only = dataset.copy()
    for name in ("layer_element_stress", "sample_element_stress"):
        stress = np.zeros(only[name].shape)
        stress[2, 2] = -3e-3
        only[name] = only[name].copy(data=stress)
    for colour in ("stress_zz", "mises"):
        np.testing.assert_allclose(meshes(op.plot_section(only, colour=colour))[1].get_array(), 3.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"y": 3.0}, r"plot_section\.y \[mm\] must lie between 0 and 2, got 3"),
        ({"colour": "sxx"}, r"colour must be one of \('stress_zz', 'mises'\), got 'sxx'"),
    ],
)
def test_options_are_checked(dataset, options, message):
    with pytest.raises(ValueError, match=message):
        op.plot_section(dataset, **options)


def test_a_palpation_has_no_section(solution):
    with pytest.raises(ValueError, match="both bodies of an experiment"):
        op.plot_section(op.to_xarray(solution))


def test_truth_estimate_and_error_share_their_colours(truth):
    compared = op.compare(np.full((9, 9), float(truth.pressure.mean())), truth)
    axes = op.plot_comparison(compared)
    images = [ax.images[0] for ax in axes]
    assert images[0].get_clim() == images[1].get_clim()
    np.testing.assert_allclose(images[2].get_array(), 1e3 * compared.error)
    assert f"{compared.relative_error:.1%}" in axes[2].get_title()


def test_pictures_of_a_simulation_need_no_display(dataset, truth):
    figures = draw_simulation(dataset, truth.thickness)
    assert set(figures) == {"section.png", "report.png"}
    assert plt.get_fignums() == []


def test_maps_and_scenes_take_the_solution(truth):
    assert op.plot_pressure(truth).get_xlabel() == "x [mm]"
    assert op.plot_status(truth, window=True).get_ylabel() == "y [mm]"
    scene = op.plot_layer(truth, off_screen=True)
    scene.close()
