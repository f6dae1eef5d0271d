"""The example map has what real maps have, and gives the same numbers every time."""

import numpy as np

from opfem.measurement import EXAMPLE_LAYER, example_map


def test_example_has_what_real_maps_have():
    example = example_map()
    data = np.asarray(example.values)[~np.asarray(example.mask)]
    assert example.shape == (201, 201)
    assert tuple(example.extent.tolist()) == (5.0, 5.0)
    assert float(example.std) == 0.002
    assert not example.is_filled
    assert 100 < int(example.mask.sum()) < 2000
    assert 0.25 < 1 - data.min() / EXAMPLE_LAYER < 0.33
    corner = np.asarray(example.values)[-20:, -20:]
    assert EXAMPLE_LAYER < corner.mean() < EXAMPLE_LAYER + 0.01


def test_example_is_reproducible():
    np.testing.assert_array_equal(example_map().values, example_map(seed=0).values)
    assert not np.array_equal(example_map(seed=1).values, example_map().values)


def test_example_noise_is_what_it_says():
    first, second = np.asarray(example_map(seed=1).values), np.asarray(example_map(seed=2).values)
    data = ~np.asarray(example_map().mask)
    # The std of 40 000 pixels is known to 0.4%.
    np.testing.assert_allclose((first - second)[data].std() / np.sqrt(2), 0.002, 0.02)
