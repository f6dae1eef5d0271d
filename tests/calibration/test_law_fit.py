"""Calibration against exact data, published curves, felupe, and the scatter over many draws of noise."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import opfem as op
from opfem.calibration.covariance import correlated_covariance
from opfem.calibration.platens import bonded_factor
from opfem.calibration.result import Calibration
from opfem.model import stable_stretches
from opfem.model.homogeneous import nominal_stress
from tests.experiments import published_palpation

EXACT = 1e-8
"""What the fit's stopping tolerance leaves of exact data."""
PUBLISHED = 0.01
"""Printed figures have three digits."""

COMPRESSION = np.linspace(1.0, 0.6, 60)
LAWS = {
    "neo_hooke": op.NeoHooke(2.9e-3, bulk=np.inf),
    "mooney_rivlin": op.MooneyRivlin(2.23e-3, 7.03e-4, bulk=np.inf),
    "yeoh": op.Yeoh(3.0e-3, 2.4e-4, 3e-4, bulk=np.inf),
    "ogden": op.Ogden([6.0e-3], [1.35], bulk=np.inf),
    "hencky": op.Hencky(5.6e-3, bulk=np.inf),
}
# Treloar, Trans. Faraday Soc. 40 (1944) 59, uniaxial; as felupe's documentation prints it: stretch, kgf/cm².
TRELOAR = np.array(
    [
        *([1.02, 0.26], [1.125, 1.37], [1.24, 2.3], [1.39, 3.23], [1.585, 4.16], [1.9, 5.1], [2.18, 6.0], [2.42, 6.9]),
        *([3.02, 8.8], [3.57, 10.7], [4.03, 12.5], [4.76, 16.2], [5.36, 19.9], [5.75, 23.6], [6.15, 27.4], [6.4, 31.0]),
        *([6.6, 34.8], [6.85, 38.5], [7.05, 42.1], [7.15, 45.8], [7.25, 49.6], [7.4, 53.3], [7.5, 57.0], [7.6, 64.4]),
    ]
)
KGF_CM2 = 0.0980665  # MPa


def curve(material, stretch=COMPRESSION, mode="uniaxial", offset=0.0, noise=0.0):
    nominal = nominal_stress(material, jnp.asarray(stretch), mode, bool(np.isinf(material.bulk)))
    return op.StressStrain(stretch, nominal + offset + noise, mode=mode)


def numbers_of(found):
    return {name: np.asarray(value) for name, value in found.unknown["numbers"].items()}


@pytest.mark.parametrize("law", LAWS)
def test_exact_data_gives_the_numbers_back(law):
    found = op.calibrate(curve(LAWS[law], offset=4e-5), law)
    for name, value in numbers_of(found).items():
        np.testing.assert_allclose(value, getattr(LAWS[law], name), rtol=EXACT)
    assert float(found.offset[0]) == pytest.approx(4e-5, rel=1e-6)
    assert float(found.modulus) == pytest.approx(3.0 * float(LAWS[law].shear), rel=EXACT)


def test_two_terms_and_three_modes():
    law = op.Ogden([4e-3, 1e-3], [2.0, -3.0], bulk=np.inf)
    data = [curve(law, np.linspace(1.0, 0.6, 40)), curve(law, np.linspace(1.0, 1.8, 40), "equibiaxial", offset=1e-4)]
    data.append(curve(law, np.linspace(1.0, 2.0, 40), "planar"))
    found = op.calibrate(data, "ogden", terms=2)
    order = np.argsort(found.material.alpha)
    np.testing.assert_allclose(np.asarray(found.material.mu)[order], [1e-3, 4e-3], rtol=1e-6)
    np.testing.assert_allclose(found.offset, [0.0, 1e-4, 0.0], atol=1e-10)


@pytest.mark.parametrize("mode", ["uniaxial", "equibiaxial", "planar"])
def test_incompressible_stress_is_the_closed_form(mode):
    s, (c10, c01) = np.linspace(0.6, 1.7, 12), (2.23e-3, 7.03e-4)
    closed = {
        "uniaxial": 2 * (s - s**-2) * (c10 + c01 / s),
        "equibiaxial": 2 * (s - s**-5) * (c10 + c01 * s**2),
        "planar": 2 * (s - s**-3) * (c10 + c01),
    }[mode]
    np.testing.assert_allclose(nominal_stress(LAWS["mooney_rivlin"], jnp.asarray(s), mode, True), closed, rtol=1e-12)


def test_finite_bulk_frees_the_sides():
    law = op.MooneyRivlin(2.23e-3, 7.03e-4, bulk=20 * 5.866e-3)
    found = op.calibrate(curve(law), bulk=20)
    np.testing.assert_allclose([found.material.c10, found.material.c01], [2.23e-3, 7.03e-4], rtol=EXACT)
    assert float(found.material.bulk) == pytest.approx(0.11732, rel=EXACT)
    assert float(found.modulus) == pytest.approx(9 * 20 * 5.866e-3 / 61, rel=EXACT)


def test_felupe_gives_the_same_curve():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import felupe
    law = felupe.Hyperelastic(felupe.mooney_rivlin, C10=2.23e-3, C01=7.03e-4)
    stretch = np.linspace(1.0, 0.7, 12)
    ux, *_ = law.view(incompressible=True, ux=stretch, ps=None, bx=None).evaluate()
    np.testing.assert_allclose(ux[1], curve(LAWS["mooney_rivlin"], stretch).nominal, atol=1e-9)
    found = op.calibrate(op.StressStrain(stretch, ux[1]), "mooney_rivlin")
    np.testing.assert_allclose([found.material.c10, found.material.c01], [2.23e-3, 7.03e-4], rtol=1e-5)


@pytest.mark.parametrize(
    ("law", "offset", "expected", "rms", "E0"),
    [
        ("mooney_rivlin", True, {"c10": 2.781, "c01": 0.2495, "offset": 0.078}, 0.0002, 18.18),
        ("mooney_rivlin", False, {"c10": 1.832, "c01": 0.984}, 0.028, 16.89),
        ("neo_hooke", True, {"c10": 3.091}, None, 18.55),
        ("yeoh", True, {"c10": 3.045, "c20": 0.240, "c30": -0.326}, None, 18.27),
        ("ogden", True, {"mu[0]": 6.019}, None, 18.06),
    ],
)
def test_silpuran(shared, law, offset, expected, rms, E0):
    data = op.read_stress_strain(shared / "data/silpuran_stress_strain.mat", strain="-", sign="compression")
    found = op.calibrate(data, law, offset=offset)
    for name, value in expected.items():
        assert 1e3 * float(found.numbers[name]) == pytest.approx(value, rel=PUBLISHED)
    assert 1e3 * float(found.modulus) == pytest.approx(E0, rel=PUBLISHED)
    if rms:
        assert 1e3 * float(found.rms) == pytest.approx(rms, rel=0.11)  # printed with one or two digits


@pytest.mark.parametrize(
    ("law", "top", "expected", "rms"),
    [
        ("neo_hooke", 2.5, [0.1560], None),
        ("mooney_rivlin", 2.5, [0.1038, 0.1043], 0.0089),
        ("yeoh", 2.5, [0.1935, -0.01588, 0.001828], 0.0040),
        ("yeoh", 8.0, [0.17622, -0.001854, 4.6e-5], 0.103),
    ],
)
def test_treloar(law, top, expected, rms):
    data = op.StressStrain(TRELOAR[:, 0], TRELOAR[:, 1] * KGF_CM2)
    found = op.calibrate(data, law, offset=False, range=(1.0, top))
    np.testing.assert_allclose(list(found.numbers.values()), expected, rtol=PUBLISHED)
    if rms:
        assert float(found.rms) == pytest.approx(rms, rel=PUBLISHED)


def test_ogdens_own_numbers_for_treloar():
    """Ogden 1972: Σ m_p (λ^(α-1) - λ^(-α/2-1)) with m = 0.63, 0.0012, -0.01 MPa; mu = m α / 2."""
    law = op.Ogden([0.4095, 0.003, 0.01], [1.3, 5.0, -2.0], bulk=np.inf)
    inside = TRELOAR[:, 0] < 7
    off = nominal_stress(law, jnp.asarray(TRELOAR[inside, 0]), "uniaxial", True) - TRELOAR[inside, 1] * KGF_CM2
    assert float(law.shear) == pytest.approx(0.4225)
    assert float(jnp.sqrt(jnp.mean(off**2))) == pytest.approx(0.043, rel=PUBLISHED)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_intervals_cover(correlation):
    """400 draws of noise of 1 % of the maximum; the fit is linear, so that draws share one compiled Jacobian."""
    law, n, draws = LAWS["mooney_rivlin"], 100, 400
    stretch = np.linspace(1.0, 0.6, n)
    found = op.calibrate(curve(law, stretch))
    flat = np.array(list(found.numbers.values()))
    J = np.asarray(
        jax.jacfwd(
            lambda y: found.model.residuals({"numbers": {"c01": y[0], "c10": y[1]}, "offset": y[2:]}, found.curves)
        )(jnp.asarray(flat))
    )
    rng = np.random.default_rng(4)
    sigma = 0.01 * float(jnp.max(jnp.abs(found.data[0].nominal)))
    pull = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [6.0, 6.0, 0.0]])
    inside = np.zeros(4)
    for _ in range(draws):
        noise = sigma * rng.standard_normal(n)
        for i in range(1, n):
            noise[i] = correlation * noise[i - 1] + np.sqrt(1 - correlation**2) * noise[i]
        error = np.linalg.lstsq(J, noise, rcond=None)[0]
        said = correlated_covariance(noise - J @ error, J, [slice(0, n)], 1.0)
        std = np.sqrt(np.einsum("ai,ij,aj->a", pull, said.matrix, pull))
        inside += np.abs(pull @ error) < 1.96 * std
    assert np.all((inside / draws >= 0.91) & (inside / draws <= 0.98)), inside / draws


def test_identifiability():
    """Compressed by 20 %, noise 1 % of the maximum: E0 to 1.5 %, the split of Mooney–Rivlin hardly."""
    rng, stretch = np.random.default_rng(1), np.linspace(1.0, 0.8, 100)
    clean = curve(LAWS["mooney_rivlin"], stretch)
    noise = 0.01 * float(jnp.max(jnp.abs(clean.nominal))) * rng.standard_normal(100)
    found = op.calibrate(curve(LAWS["mooney_rivlin"], stretch, noise=noise))
    assert float(found.correlation[0, 1]) == pytest.approx(-0.9991, abs=1e-3)
    assert 1e3 * float(found.std["c10"]) == pytest.approx(0.21, rel=0.3)
    assert 1e3 * float(found.modulus_std) == pytest.approx(0.25, rel=0.3)
    assert any("poorly identified" in said and "neo_hooke" in said for said in found.advice())


def test_criterion_takes_the_law_that_the_data_need():
    noise = 1e-5 * np.random.default_rng(2).standard_normal(COMPRESSION.size)
    for truth in ("neo_hooke", "mooney_rivlin"):
        data = curve(LAWS[truth], noise=noise)
        aic = {law: float(op.calibrate(data, law).aic) for law in ("neo_hooke", "mooney_rivlin")}
        assert min(aic, key=lambda law: aic[law]) == truth


def test_stable_ranges_of_known_laws():
    """Mooney–Rivlin laws with negative coefficients [kPa], to 1 %."""
    ranges = [
        stable_stretches(op.MooneyRivlin(1e-3 * a, 1e-3 * b, bulk=1.0))
        for a, b in ((2.23, 0.703), (-0.278, 2.7), (-1.35, 4.14), (-33.9, 43.0))
    ]
    assert all(low < 0.301 and high > 2.99 for low, high in ranges[0].values())
    assert ranges[1]["uniaxial"][0] < 0.33  # below, along the path still stable, it shears in its own plane
    assert ranges[1]["uniaxial"][1] > 2.99
    assert ranges[1]["equibiaxial"][0] == pytest.approx(0.45, rel=PUBLISHED)
    assert ranges[2]["uniaxial"][1] == pytest.approx(1.86, rel=PUBLISHED)
    assert ranges[2]["equibiaxial"][0] == pytest.approx(0.73, rel=PUBLISHED)
    assert ranges[3]["uniaxial"][1] == pytest.approx(1.13, rel=PUBLISHED)
    assert ranges[3]["equibiaxial"][0] == pytest.approx(0.94, rel=PUBLISHED)


def test_true_stress_read_as_nominal_is_noticed():
    data = curve(LAWS["mooney_rivlin"])
    swapped = op.StressStrain(data.stretch, data.nominal * data.stretch)
    assert any("Pass kind=" in said for said in op.calibrate(swapped).advice())
    assert not any("Pass kind=" in said for said in op.calibrate(data).advice())


def test_late_contact_is_an_offset_in_strain():
    data = curve(LAWS["neo_hooke"])
    late = op.StressStrain(np.asarray(data.stretch) * 0.98, data.nominal)
    found = op.calibrate(late, "neo_hooke", toe="strain")
    assert float(found.offset[0]) == pytest.approx(-0.02, rel=1e-7)
    assert float(found.material.c10) == pytest.approx(2.9e-3, rel=EXACT)


def test_relative_weights_and_stds_weigh():
    noise = 2e-4 * np.sin(40 * COMPRESSION)
    data = curve(LAWS["neo_hooke"], noise=noise)
    std = np.where(COMPRESSION > 0.8, 1e-6, 1.0)
    known = op.StressStrain(
        data.stretch, np.where(COMPRESSION > 0.8, curve(LAWS["neo_hooke"]).nominal, data.nominal), std
    )
    assert float(op.calibrate(known, "neo_hooke").material.c10) == pytest.approx(2.9e-3, rel=1e-6)
    plain, relative = (op.calibrate(data, "neo_hooke", weights=w).material.c10 for w in ("absolute", "relative"))
    assert abs(float(plain / relative) - 1.0) > 1e-4


def test_bonded_platens():
    """Gent–Lindley, 1 + 2 S², is within 3 % of an incompressible disc; a thin compressible one tends to its own."""
    for slenderness in (0.25, 0.5, 1.0, 2.5):
        factor = bonded_factor(4.0 * slenderness, 1.0, None)
        assert factor == pytest.approx(1 + 2 * slenderness**2, rel=0.035)
    assert bonded_factor(10.0, 1.0, 20.0) == pytest.approx(4.42, rel=2e-3)
    data = curve(LAWS["neo_hooke"])
    stiff = op.StressStrain(data.stretch, data.nominal * bonded_factor(16.0, 5.5, None))
    found = op.calibrate(stiff, "neo_hooke", platens="bonded", diameter=16.0, height=5.5)
    assert float(found.material.c10) == pytest.approx(2.9e-3, rel=EXACT)
    assert any("bonded platens" in said for said in found.advice())
    with pytest.raises(ValueError, match="diameter"):
        op.calibrate(stiff, platens="bonded")


def test_a_solve_says_where_it_leaves_the_tests():
    near, far = (
        op.calibrate(curve(LAWS["neo_hooke"], np.linspace(1.0, low, 30)), "neo_hooke", bulk=20).material
        for low in (0.95, 0.5)
    )
    flat = op.ThicknessMap(np.full((5, 5), 0.43), extent=(2.0, 2.0))
    for law, is_beyond in ((near, True), (far, False)):
        palpation = published_palpation()
        palpation = op.Palpation(
            op.Layer(0.5, law), extent=(2.0, 2.0), elements=(2, 2, 1), window=palpation.window, sample=palpation.sample
        )
        solution = op.solve(palpation, op.Imprint(flat))
        least = float(solution.stats["min_stretch"])
        beyond = float(solution.stats["beyond_calibration"])
        assert (beyond > 0) == is_beyond
        assert beyond == pytest.approx(
            max(0.0, law.calibrated[0] / least - 1, float(solution.stats["max_stretch"]) / law.calibrated[1] - 1)
        )
        assert float(op.to_xarray(solution).attrs.get("beyond_calibration", beyond)) == pytest.approx(beyond)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"law": "mooney"}, "must be one of neo_hooke, mooney_rivlin"),
        ({"bulk": 0.5}, "above 1"),
        ({"terms": 4}, "terms must be 1, 2 or 3"),
        ({"range": (0.1, 0.2)}, "between stretches"),
        ({"law": op.model.material.AbstractInvariantMaterial}, "needs start="),
    ],
)
def test_arguments_that_mean_nothing(change, message):
    with pytest.raises(ValueError, match=message):
        op.calibrate(curve(LAWS["neo_hooke"]), **change)


def test_curves_that_are_no_material():
    data = curve(LAWS["neo_hooke"])
    with pytest.raises(op.MeasurementError, match="is the sign of one of them wrong"):
        op.calibrate(op.StressStrain(data.stretch, -data.nominal))
    bent = -2e-3 * np.tanh((1 - COMPRESSION) / 0.05) + 1e-4 * (1 - COMPRESSION)
    with pytest.raises(op.MeasurementError, match=r"unstable within|no material"):
        op.calibrate(op.StressStrain(COMPRESSION, bent), "yeoh")


def test_specimens_that_differ_are_a_finding():
    data = curve(LAWS["neo_hooke"])
    first, second = (op.StressStrain(data.stretch, data.nominal, area=area) for area in (283.0, 201.0))
    assert any("differ in area: 283, 201 mm²" in said for said in op.calibrate([first, second], "neo_hooke").advice())


def test_picture():
    found = op.calibrate(
        [curve(LAWS["mooney_rivlin"], offset=1e-4), curve(LAWS["mooney_rivlin"], np.linspace(1, 1.3, 20), "planar")]
    )
    assert isinstance(found, Calibration)
    stress, residuals = op.plot_calibration(found, Figure())
    points = stress.lines[0]
    np.testing.assert_allclose(points.get_xdata(), 100 * (1 - COMPRESSION))
    np.testing.assert_allclose(points.get_ydata(), -1e3 * np.asarray(curve(LAWS["mooney_rivlin"]).nominal), atol=1e-6)
    np.testing.assert_allclose(residuals.lines[0].get_ydata(), 0.0, atol=1e-6)
    assert "MooneyRivlin: c01=" in repr(found)
