"""Contact and friction at face points: closed forms, derivatives, Coulomb's return map and its history."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.contact_body import ImposedPressure, RigidSurface
from opfem.mechanics.contact_face import ContactFace
from opfem.mechanics.contact_state import ContactIterate, TangentLaw
from opfem.mechanics.face import assemble_face, gather_face, quadrature
from opfem.model import height_field
from tests.oracles import assemble_dense_face
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

NX = NY = 2
EXTENT = (1.0, 0.8)
AREA = EXTENT[0] * EXTENT[1]
PLANE = RigidSurface(None, None)
P0, C0 = 2.0, 0.01
STIFFNESS, ELEMENT_SIZE = 0.5, 0.45
NOW = jnp.asarray(1.0)
SIDES = pytest.mark.parametrize("above", [True, False], ids=["sample", "window"])
RULES = pytest.mark.parametrize("rule", ["gauss2", "gauss3", "nodes"])


def located(face, x):
    return face.locate(NOW, gather_face(x), bends=True)


def nodal_force(face, x, history, law=None):
    return assemble_face(face.force(face.locate(NOW, gather_face(x)), history, law))


_force = eqx.filter_jit(nodal_force)
_matrices = eqx.filter_jit(lambda face, x, history, law=None: face.stiffness_matrices(located(face, x), history, law))
_advance = eqx.filter_jit(lambda face, x, history: face.advance(located(face, x), history))
_jacobian = eqx.filter_jit(lambda face, x, history: jax.jacfwd(lambda v: nodal_force(face, v, history))(x))


def contact_face(contact, surface=PLANE, above=False, rule="gauss2", offset=0.0, imposed=None, sides=None):
    numbers = (jnp.asarray(v, float) for v in (ELEMENT_SIZE, STIFFNESS))
    return ContactFace(contact, surface, jnp.asarray(offset, float), imposed, *numbers, above, rule, sides)


def flat(z=0.0, slope=(0.0, 0.0), shape=(NY, NX), extent=EXTENT):
    y, x = np.meshgrid(np.linspace(0, extent[1], shape[0] + 1), np.linspace(0, extent[0], shape[1] + 1), indexing="ij")
    return np.stack([x, y, z + slope[0] * x + slope[1] * y])


def moved(face, x=0.0, y=0.0, z=0.0):
    return jnp.array(face + np.array([x, y, z])[:, None, None])


def plane_surface(height, slope=(0.0, 0.0)):
    y, x = np.meshgrid(np.linspace(-1, 2, 4), np.linspace(-1, 2, 4), indexing="ij")
    values = jnp.array(height + slope[0] * x + slope[1] * y)
    field = height_field(values, jnp.array([-1.0, -1.0]), jnp.array([1.0, 1.0]), "bilinear")
    return RigidSurface(field, field)


def bumpy_surface(height):
    y, x = np.meshgrid(np.linspace(-1, 2, 13), np.linspace(-1, 2, 13), indexing="ij")
    values = jnp.array(height - 0.06 * np.cos(2.3 * x + 0.4) * np.sin(1.9 * y + 0.2))
    field = height_field(values, jnp.array([-1.0, -1.0]), jnp.array([0.25, 0.25]), "cubic")
    return RigidSurface(field, field)


def exponential(clearance):
    s = np.maximum(1 - clearance / C0, 0.0)
    return P0 / (np.e - 1) * s * np.expm1(s)


EXPONENTIAL = op.ExponentialOverclosure(P0, C0)
LAWS = [
    (op.HardOverclosure(20.0), lambda g: 20.0 * STIFFNESS * np.maximum(-g, 0.0)),
    (op.LinearOverclosure(7.0), lambda g: 7.0 * np.maximum(-g, 0.0)),
    (EXPONENTIAL, exponential),
]


# Normal contact


@SIDES
@pytest.mark.parametrize(("law", "pressure"), LAWS, ids=["hard", "linear", "exponential"])
def test_force_on_a_flat_face_is_pressure_times_area(law, pressure, above):
    side = 1.0 if above else -1.0
    face = contact_face(op.Contact(law, friction=0.1), plane_surface(0.5) if above else PLANE, above)
    level = 0.5 if above else 0.0
    for clearance in (-0.004, 0.004, 0.02):
        x = jnp.array(flat(level - side * clearance))
        force = np.asarray(_force(face, x, face.initial_history(gather_face(x))))
        np.testing.assert_allclose(
            force.sum(axis=(1, 2)), [0, 0, -side * pressure(clearance) * AREA], ROUNDOFF, ROUNDOFF
        )
        corner = pressure(clearance) * AREA / (4 * NX * NY)
        np.testing.assert_allclose(np.abs(force[2, ::2, ::2]), corner, 10 * ROUNDOFF, ROUNDOFF)


@RULES
def test_force_acts_on_the_current_area(rule):
    face = contact_face(op.Contact(op.LinearOverclosure(7.0), friction=0.0), rule=rule)
    x = flat(-0.01) * np.array([1.3, 0.8, 1.0])[:, None, None]
    force = np.asarray(_force(face, jnp.array(x), face.initial_history(gather_face(jnp.array(x)))))
    np.testing.assert_allclose(force.sum(axis=(1, 2)), [0.0, 0.0, 0.07 * 1.04 * AREA], ROUNDOFF, ROUNDOFF)


@SIDES
def test_force_on_a_tilted_plane_is_along_its_normal(above):
    side, slope = (1.0 if above else -1.0), np.array([0.5, -0.3])
    stretch = np.sqrt(1 + slope @ slope)
    face = contact_face(op.Contact(op.LinearOverclosure(7.0), friction=0.0), plane_surface(0.5, slope), above)
    x = jnp.array(flat(0.5 + side * 0.01, slope))
    total = np.asarray(_force(face, x, face.initial_history(gather_face(x)))).sum(axis=(1, 2))
    normal = np.array([-slope[0], -slope[1], 1.0]) / stretch
    # The vertical overclosure of 0.01 is 0.01/stretch along the normal; the area grows by stretch.
    np.testing.assert_allclose(total, -side * 7.0 * 0.01 * AREA * normal, ROUNDOFF)


@SIDES
def test_offset_moves_the_surface_away_from_the_layer(above):
    side = 1.0 if above else -1.0
    face = contact_face(op.Contact(op.LinearOverclosure(7.0), 0.0), plane_surface(0.5), above, offset=0.004)
    x = jnp.array(flat(0.5 + side * 0.01))
    total = np.asarray(_force(face, x, face.initial_history(gather_face(x)))).sum(axis=(1, 2))
    np.testing.assert_allclose(total[2], -side * 7.0 * 0.006 * AREA, ROUNDOFF)


def test_surface_moves_in_a_straight_line_from_start_to_end():
    start, end = plane_surface(0.5).start, plane_surface(0.4, (0.2, 0.0)).start
    height, slope, _ = RigidSurface(start, end).at(jnp.asarray(0.25), jnp.array([0.5]), jnp.array([0.3]))
    np.testing.assert_allclose([height[0], slope[0]], [0.75 * 0.5 + 0.25 * 0.5, 0.05], ROUNDOFF)


def test_open_contact_has_no_force_and_no_stiffness():
    face = contact_face(op.Contact(EXPONENTIAL, friction=0.2))
    x = jnp.array(flat(2 * C0))
    history = face.initial_history(gather_face(x))
    np.testing.assert_array_equal(_force(face, moved(x, x=0.1), history), 0.0)
    for matrix in _matrices(face, moved(x, x=0.1), history):
        np.testing.assert_array_equal(matrix, 0.0)


# Derivatives


@pytest.fixture(scope="module")
def rough():
    """A face that lies unevenly under the bumps, closed everywhere, in an exponential law of moderate stiffness."""
    rng = np.random.default_rng(0)
    return flat(0.5, (0.02, -0.01)) + 0.02 * rng.standard_normal((3, NY + 1, NX + 1))


SOFT = op.ExponentialOverclosure(pressure=0.5, clearance=0.3)


def bumpy_face(friction, elastic_slip):
    return contact_face(op.Contact(SOFT, friction, elastic_slip=elastic_slip), bumpy_surface(0.5), above=True)


STATES = {
    "frictionless": (0.0, 0.02, 0.1),
    "at rest": (0.4, 0.02, 0.0),
    "sticking": (0.4, 0.02, 0.01),
    "sliding": (0.4, 0.02, 0.1),
    "sticking and sliding": (0.4, 0.02, 0.019),
}


def bumpy_state(state, rough):
    friction, elastic_slip, slip = STATES[state]
    face = bumpy_face(friction, elastic_slip)
    history = face.initial_history(gather_face(jnp.array(rough)))
    change = slip * (
        np.array([0.8, 0.6, 0.1])[:, None, None] + 0.2 * np.random.default_rng(1).standard_normal(rough.shape)
    )
    return face, jnp.array(rough + change), history


@pytest.mark.parametrize("state", STATES)
def test_stiffness_is_minus_the_derivative_of_force_on_a_curved_surface(state, rough):
    face, x, history = bumpy_state(state, rough)
    point = face.at_points(located(face, x), history)
    assert np.all(point.pressure > 0)
    share = {"sliding": 1.0, "frictionless": 1.0, "sticking": 0.0, "at rest": 0.0}.get(state)
    assert np.mean(point.sliding) == share if share is not None else 0.2 < np.mean(point.sliding) < 0.8
    exact, _ = _matrices(face, x, history)
    expected = -np.asarray(_jacobian(face, x, history)).reshape(x.size, x.size)
    np.testing.assert_allclose(
        assemble_dense_face(np.asarray(exact)), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max()
    )


def _points(face, x):
    q = quadrature(face.rule)
    return jnp.array(
        [
            [
                [[sum(n * x[c, j + k // 2, i + k % 2] for k, n in enumerate(N)) for i in range(NX)] for j in range(NY)]
                for N in q.N
            ]
            for c in range(3)
        ]
    )


@pytest.mark.parametrize("state", ["sticking", "sliding"])
def test_force_equals_a_loop_over_points(state, rough):
    """Every step of contact written out for one point after the other."""
    friction, elastic_slip, _ = STATES[state]
    face, x, history = bumpy_state(state, rough)
    q = quadrature(face.rule)
    expected = np.zeros(x.shape)
    surface = jax.jit(lambda a, b: face.surface.at(NOW, a, b))
    for j, i, point in itertools.product(range(NY), range(NX), range(4)):
        nodes = [(j + k // 2, i + k % 2) for k in range(4)]
        now, before = (
            sum(n * np.asarray(f)[:, *at] for n, at in zip(q.N[point], nodes, strict=True)) for f in (x, rough)
        )
        tangents = [sum(d * np.asarray(x)[:, *at] for d, at in zip(q.dN[point][k], nodes, strict=True)) for k in (0, 1)]
        height, *slope = (float(v[0]) for v in surface(jnp.array(now[:1]), jnp.array(now[1:2])))
        normal = np.array([-slope[0], -slope[1], 1.0])
        clearance = (height - now[2]) / np.linalg.norm(normal)
        s = 1 - clearance / 0.3
        pressure = 0.5 / (np.e - 1) * s * np.expm1(s)
        slip = now[:2] - before[:2]
        along = np.array([*slip, slip @ slope])
        reach = np.linalg.norm(along)
        pull = friction * pressure * min(reach / elastic_slip, 1.0) * along / reach
        density = (-pressure * normal / np.linalg.norm(normal) - pull) * np.linalg.norm(np.cross(*tangents))
        for n, at in zip(q.N[point], nodes, strict=True):
            expected[:, *at] += q.weights[point] * n * density
    np.testing.assert_allclose(_force(face, x, history), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max())


OTHER_FACES = {
    "window with constant sticking slope": lambda x: contact_face(
        op.Contact(op.LinearOverclosure(7.0), 0.3, stick_slope=4.0), rule="gauss3", offset=-0.2
    ),
    "some of them sides": lambda x: contact_face(
        op.Contact(SOFT, 0.3), bumpy_surface(0.2), above=True, sides=jnp.array([[True, False], [False, True]])
    ),
    "dead pressure": lambda x: contact_face(
        op.Contact(EXPONENTIAL, 0.3),
        above=True,
        rule="nodes",
        imposed=ImposedPressure(
            jnp.zeros((4, NY, NX)), gather_face(jnp.array(0.1 + x[2:]))[:, 0], jnp.full((4, NY, NX), 0.2)
        ),
    ),
    "bed of springs": lambda x: contact_face(
        op.Contact(EXPONENTIAL, 0.3),
        above=True,
        rule="nodes",
        imposed=ImposedPressure(
            *jnp.zeros((2, 4, NY, NX)),
            jnp.full((4, NY, NX), 0.2),
            gather_face(jnp.array(x[2:]))[:, 0] - 0.1,
            (jnp.asarray(0.3), jnp.asarray(0.7)),
        ),
    ),
}


@pytest.mark.parametrize("slip", [0.0005, 0.05])
@pytest.mark.parametrize("name", OTHER_FACES)
def test_stiffness_is_minus_the_derivative_of_force(name, slip):
    x = flat(0.1) + 0.02 * np.random.default_rng(2).standard_normal((3, NY + 1, NX + 1))
    face = OTHER_FACES[name](x)
    history = face.initial_history(gather_face(jnp.array(x)))
    now = moved(x, x=slip, y=0.3 * slip)
    exact, _ = _matrices(face, now, history)
    expected = -np.asarray(_jacobian(face, now, history)).reshape(x.size, x.size)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(
        assemble_dense_face(np.asarray(exact)), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max()
    )


@pytest.mark.parametrize("state", STATES)
def test_guard_is_symmetric_and_positive(state, rough):
    _, guard = _matrices(*bumpy_state(state, rough))
    guard = np.transpose(guard, (4, 5, 0, 2, 1, 3)).reshape(NY * NX, 12, 12)
    scale = np.abs(guard).max()
    assert scale > 0
    np.testing.assert_allclose(guard, np.swapaxes(guard, 1, 2), atol=ROUNDOFF * scale)
    assert np.linalg.eigvalsh(guard).min() > -ROUNDOFF * scale


def test_guard_is_the_whole_stiffness_of_a_face_that_just_touches():
    """Without pressure there is no area change, no geometry and no friction to leave out."""
    face = contact_face(op.Contact(op.HardOverclosure(7.0), friction=0.1))
    x = jnp.array(flat())
    exact, guard = _matrices(face, x, face.initial_history(gather_face(x)))
    np.testing.assert_allclose(exact, guard, ROUNDOFF, ROUNDOFF)
    total = np.asarray(guard).sum(axis=(0, 1, 4, 5))
    np.testing.assert_allclose(total, np.diag([0.0, 0.0, 7 * STIFFNESS * AREA]), ROUNDOFF, ROUNDOFF)


# The linearised law of a Newton step


def _iterate(pressure, history):
    return ContactIterate(pressure, jnp.zeros_like(history.elastic), jnp.zeros_like(history.pressure))


@pytest.mark.parametrize("state", ["sticking", "sliding"])
def test_law_linearised_at_its_own_pressure_changes_nothing(state, rough):
    face, x, history = bumpy_state(state, rough)
    point = face.at_points(located(face, x), history)
    law = face.tangent_law(located(face, x), history, _iterate(point.pressure, history), jnp.ones(()))
    assert isinstance(law, TangentLaw)
    own, linear = _force(face, x, history), _force(face, x, history, law)
    np.testing.assert_allclose(linear, own, 10 * ROUNDOFF, 10 * ROUNDOFF * np.abs(own).max())
    for got, expected in zip(_matrices(face, x, history, law), _matrices(face, x, history), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=100 * ROUNDOFF * np.abs(expected).max())


def test_linearised_law_is_the_tangent_at_the_iterates_pressure():
    """With a pressure of its own, 0.02 MPa, that the clearance does not have yet."""
    face = contact_face(op.Contact(EXPONENTIAL, friction=0.0))
    x = jnp.array(flat(0.009))
    history = face.initial_history(gather_face(x))
    start = _iterate(jnp.full_like(history.pressure, 0.02), history)
    law = face.tangent_law(located(face, x), history, start, jnp.ones(()))
    low, high = 0.0, 1.0
    for _ in range(200):  # bisection for the s of this pressure
        s = (low + high) / 2
        low, high = (s, high) if s * np.expm1(s) * P0 / (np.e - 1) < 0.02 else (low, s)
    slope = -P0 / (C0 * (np.e - 1)) * ((1 + s) * np.exp(s) - 1)
    expected = 0.02 + slope * (0.009 - C0 * (1 - s))
    np.testing.assert_allclose(law(jnp.full_like(history.pressure, 0.009)), expected, 10 * ROUNDOFF)
    total = np.asarray(_force(face, x, history, law)).sum(axis=(1, 2))
    np.testing.assert_allclose(total[2], expected * AREA, 10 * ROUNDOFF)


def test_pressure_follows_the_clearance_over_a_step():
    """A linear law ends at its own pressure after a full step, and halfway after half of one."""
    face = contact_face(op.Contact(op.LinearOverclosure(7.0), friction=0.0))
    x = jnp.array(flat(-0.01))
    history = _advance(face, x, face.initial_history(gather_face(x)))
    law = face.tangent_law(located(face, x), history, face.initial_iterate(history), jnp.ones(()))
    change = moved(np.zeros(x.shape), z=-0.004)
    for length in (1.0, 0.5):
        after = face.follow(located(face, x), gather_face(change), history, law).after(jnp.asarray(length))
        np.testing.assert_allclose(after.pressure, 7.0 * (0.01 + 0.004 * length), ROUNDOFF)
    opened = face.follow(located(face, x), gather_face(moved(np.zeros(x.shape), z=0.1)), history, law)
    np.testing.assert_array_equal(opened.after(jnp.asarray(1.0)).pressure, 0.0)


@pytest.mark.parametrize(("back", "sticks"), [(0.01, False), (-0.01, True)])
def test_a_sliding_point_that_reverses_sticks_for_one_step(back, sticks):
    face = contact_face(op.Contact(op.LinearOverclosure(7.0), friction=0.3, elastic_slip=1e-3))
    x = jnp.array(flat(-0.01))
    history = _advance(face, x, face.initial_history(gather_face(x)))
    law = face.tangent_law(located(face, x), history, face.initial_iterate(history), jnp.ones(()))
    slid = face.follow(located(face, moved(x, x=0.02)), gather_face(jnp.zeros_like(x)), history, law)
    np.testing.assert_allclose(slid.direction[0], 1e-3, ROUNDOFF)
    following = face.tangent_law(located(face, moved(x, x=back)), history, slid, jnp.ones(()))
    assert np.all(following.sticks == sticks)


# Coulomb friction


UNIT = flat(shape=(1, 1), extent=(1.0, 1.0))


def coulomb_block(above=False, **given):
    """Test 27 of docs/validation.md: 1 mm² under 10 MPa, friction 0.3, sticking slope 100 N/mm."""
    contact = op.Contact(op.LinearOverclosure(100.0), friction=0.3, **(given or {"stick_slope": 100.0}))
    return contact_face(contact, plane_surface(0.0) if above else PLANE, above)


def pressed(u, above=False, direction=(1.0, 0.0), overclosure=0.1):
    return moved(UNIT, u * direction[0], u * direction[1], overclosure if above else -overclosure)


def tangential_force(face, x, history):
    return np.asarray(_force(face, x, history)).sum(axis=(1, 2))[:2]


def bilinear_hysteresis(path):
    """Force of an elastic slip of stiffness 100 that is bounded by 3, step by step."""
    T, forces = 0.0, []
    for change in np.diff(path, prepend=0.0):
        T = np.clip(T - 100 * change, -3, 3)
        forces.append(T)
    return np.array(forces)


@SIDES
@pytest.mark.parametrize("given", [{"stick_slope": 100.0}, {"elastic_slip": 0.03}], ids=["stick_slope", "elastic_slip"])
def test_27_coulomb_block_under_cyclic_slip(above, given):
    face = coulomb_block(above, **given)
    quarter = np.linspace(0, 0.2, 21)
    cycle = np.concatenate([quarter[-2::-1], -quarter[1:], -quarter[-2::-1], quarter[1:]])
    path = np.concatenate([quarter, cycle, cycle])
    history = face.initial_history(gather_face(pressed(0.0, above)))
    forces, dissipated = [], []
    for u in path:
        x = pressed(u, above)
        forces.append(tangential_force(face, x, history))
        history = _advance(face, x, history)
        dissipated.append(float(history.dissipated))
    forces = np.array(forces)
    np.testing.assert_allclose(forces[:, 0], bilinear_hysteresis(path), atol=10 * ROUNDOFF)
    np.testing.assert_allclose(forces[:, 1], 0.0, atol=ROUNDOFF)
    np.testing.assert_allclose(forces[:4, 0], [0.0, -1.0, -2.0, -3.0], atol=10 * ROUNDOFF)  # sticks to u = 0.03
    np.testing.assert_allclose(forces[4:21, 0], -3.0, 10 * ROUNDOFF)
    np.testing.assert_allclose(np.diff(forces[20:27, 0]), 1.0, 10 * ROUNDOFF)  # reversal: 100 N/mm over 0.01 mm
    assert abs(dissipated[3]) < ROUNDOFF
    np.testing.assert_allclose(dissipated[-1] - dissipated[20 + len(cycle)], 2.04, 10 * ROUNDOFF)
    work = -np.sum((forces[61:, 0][1:] + forces[61:, 0][:-1]) / 2 * np.diff(path[61:]))
    lost = dissipated[-1] - dissipated[61]
    stored = (forces[-1, 0] ** 2 - forces[61, 0] ** 2) / (2 * 100)
    np.testing.assert_allclose(work, lost + stored, 10 * ROUNDOFF)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_one_large_step_slides_along_itself(angle):
    face, direction = coulomb_block(), np.array([np.cos(angle), np.sin(angle)])
    history = face.initial_history(gather_face(pressed(0.0)))
    x = pressed(0.2, direction=direction)
    np.testing.assert_allclose(tangential_force(face, x, history), -3.0 * direction, 10 * ROUNDOFF, ROUNDOFF)
    after = _advance(face, x, history)
    shape = after.slip.shape
    along = np.broadcast_to(direction[:, None, None, None], shape)
    np.testing.assert_allclose(after.elastic, 0.03 * along, 10 * ROUNDOFF, ROUNDOFF)
    np.testing.assert_allclose(after.slip, 0.17 * along, 10 * ROUNDOFF, ROUNDOFF)
    np.testing.assert_allclose(after.dissipated, 3.0 * 0.17, 10 * ROUNDOFF)
    np.testing.assert_allclose(after.pressure, 10.0, 10 * ROUNDOFF)
    np.testing.assert_allclose(after.position[0], _points_of(UNIT)[0] + 0.2 * direction[0], ROUNDOFF)


def _points_of(x):
    N = quadrature("gauss2").N
    return np.einsum("qa,ca->cq", N, x.reshape(3, 4))[:, :, None, None]


def test_friction_on_a_slope_is_measured_along_it():
    """A point that moves by 3 in x on a slope of 4/3 slips by 5, and friction points back along the slope."""
    surface = plane_surface(0.0, (4 / 3, 0.0))
    face = contact_face(op.Contact(op.LinearOverclosure(100.0), friction=0.3, elastic_slip=0.1), surface)
    x = UNIT + np.array([np.zeros((2, 2)), np.zeros((2, 2)), 4 / 3 * UNIT[0] - 5 / 3 * 0.1])
    history = face.initial_history(gather_face(jnp.array(x)))
    start = np.asarray(_force(face, jnp.array(x), history)).sum(axis=(1, 2))
    area, tangent = 5 / 3, np.array([0.6, 0.0, 0.8])
    for u in (0.03, 0.06, 0.3):
        total = np.asarray(_force(face, moved(x, x=u, z=4 / 3 * u), history)).sum(axis=(1, 2)) - start
        expected = -0.3 * 10.0 * area * min(u * 5 / 3 / 0.1, 1.0) * tangent
        np.testing.assert_allclose(total, expected, 100 * ROUNDOFF, 100 * ROUNDOFF)


@pytest.mark.parametrize("given", [{"elastic_slip": 0.03}, {"stick_slope": 100.0}], ids=["elastic_slip", "stick_slope"])
def test_no_friction_means_no_tangential_force_and_a_finite_derivative(given):
    history = coulomb_block().initial_history(gather_face(pressed(0.0)))

    @jax.jit
    def force(friction, u):
        face = contact_face(op.Contact(op.LinearOverclosure(100.0), friction, **given))
        return nodal_force(face, pressed(0.0) + jnp.stack([u, 0.0, 0.0])[:, None, None], history)[0].sum()

    # A point that slides feels -friction × 10 N; one that has not moved feels nothing.
    for u, slope in ((0.2, -10.0), (0.0, 0.0), (-0.2, 10.0)):
        assert force(0.0, u) == 0.0
        np.testing.assert_allclose(jax.jit(jax.grad(force))(0.0, u), slope, 10 * ROUNDOFF)


def test_derivative_by_friction_equals_a_central_difference(rough):
    _, x, history = bumpy_state("sliding", rough)

    @jax.jit
    def measure(friction):
        return jnp.sum(nodal_force(bumpy_face(friction, 0.02), x, history)[:2])

    difference = (measure(0.4 + 1e-5) - measure(0.4 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(measure))(0.4), difference, FINITE_DIFFERENCE)


# History


def test_opening_forgets_the_elastic_slip():
    face = coulomb_block()
    stuck = _advance(face, pressed(0.02), face.initial_history(gather_face(pressed(0.0))))
    np.testing.assert_allclose(stuck.elastic[0], 0.02, ROUNDOFF)
    opened = _advance(face, pressed(0.05, overclosure=-0.01), stuck)
    np.testing.assert_array_equal(opened.elastic, 0.0)
    np.testing.assert_array_equal(opened.slip, stuck.slip)
    np.testing.assert_array_equal(opened.pressure, 0.0)
    assert opened.dissipated == stuck.dissipated
    np.testing.assert_allclose(tangential_force(face, pressed(0.05), opened), 0.0, atol=ROUNDOFF)
    np.testing.assert_allclose(tangential_force(face, pressed(0.07), opened), [-2.0, 0.0], 10 * ROUNDOFF, ROUNDOFF)


def test_unloading_keeps_the_elastic_slip_up_to_its_bound():
    """Half of the pressure: a given elastic slip stays, a constant sticking slope slides back to its new bound."""
    kept, bounded = coulomb_block(elastic_slip=0.03), coulomb_block(stick_slope=100.0)
    for face, elastic, force in ((kept, 0.02, -1.0), (bounded, 0.015, -1.5)):
        stuck = _advance(face, pressed(0.02), face.initial_history(gather_face(pressed(0.0))))
        half = pressed(0.02, overclosure=0.05)
        np.testing.assert_allclose(tangential_force(face, half, stuck), [force, 0.0], 10 * ROUNDOFF, ROUNDOFF)
        after = _advance(face, half, stuck)
        np.testing.assert_allclose(after.elastic[0], elastic, 10 * ROUNDOFF)
        np.testing.assert_allclose(after.slip[0], 0.02 - elastic, 10 * ROUNDOFF, ROUNDOFF)


def test_sticking_returns_all_its_work():
    face = coulomb_block()
    history = face.initial_history(gather_face(pressed(0.0)))
    for u in (0.01, 0.025, -0.02, 0.0):
        history = _advance(face, pressed(u), history)
    np.testing.assert_allclose(history.elastic, 0.0, atol=ROUNDOFF)
    np.testing.assert_array_equal(history.slip, 0.0)
    assert history.dissipated == 0.0


def test_first_contact_starts_without_friction():
    """Slip before closing leaves nothing behind."""
    face = coulomb_block()
    history = _advance(
        face, pressed(0.5, overclosure=-0.1), face.initial_history(gather_face(pressed(0.0, overclosure=-0.1)))
    )
    np.testing.assert_allclose(tangential_force(face, pressed(0.5), history), 0.0, atol=ROUNDOFF)


def test_dead_pressure_bounds_friction_and_does_not_press():
    """Traction loads apply the pressure themselves: 0.2 MPa × 0.3 × reference area, wherever the layer is."""
    pressure = jnp.full((4, 1, 1), 0.2)
    imposed = ImposedPressure(0.0 * pressure, pressure, jnp.full((4, 1, 1), 2.0))
    face = contact_face(op.Contact(EXPONENTIAL, 0.3), above=True, rule="nodes", imposed=imposed)
    history = face.initial_history(gather_face(jnp.array(UNIT)))
    for z in (-3.0, 3.0):
        total = np.asarray(_force(face, moved(UNIT, x=0.5, z=z), history)).sum(axis=(1, 2))
        np.testing.assert_allclose(total, [-0.3 * 0.2 * 2.0, 0.0, 0.0], ROUNDOFF, ROUNDOFF)
    np.testing.assert_allclose(imposed.bounding(jnp.asarray(0.5), "nodes", 0.0), 0.1, ROUNDOFF)
    pulling = ImposedPressure(0.0 * pressure, -pressure, imposed.area)
    np.testing.assert_array_equal(pulling.bounding(NOW, "nodes", 0.0), 0.0)


def test_springs_press_and_bound_friction_with_what_they_press():
    """Springs of 0.4 MPa/mm, pressed by 0.5 mm under a dead 0.2 MPa: 0.2 MPa of their own, 0.4 MPa in all."""
    dead, area = jnp.full((4, 1, 1), 0.2), jnp.full((4, 1, 1), 2.0)
    imposed = ImposedPressure(0.0 * dead, dead, area, jnp.zeros((4, 1, 1)), (jnp.asarray(0.0), jnp.asarray(0.4)))
    face = contact_face(op.Contact(EXPONENTIAL, 0.3), above=True, rule="nodes", imposed=imposed)
    history = face.initial_history(gather_face(jnp.array(UNIT)))
    raised = 0.5 - float(UNIT[2].max())
    total = np.asarray(_force(face, moved(UNIT, x=0.5, z=raised), history)).sum(axis=(1, 2))
    np.testing.assert_allclose(total, [-0.3 * 0.4 * 2.0, 0.0, -0.2 * 2.0], ROUNDOFF, ROUNDOFF)


def test_jit_equals_eager_and_vmap_a_loop(rough):
    face, x, history = bumpy_state("sticking and sliding", rough)
    states = jnp.stack([x, jnp.array(rough)])
    lanes = jax.jit(jax.vmap(lambda v: nodal_force(face, v, history)))(states)
    for state, lane in zip(states, lanes, strict=True):
        eager = np.asarray(nodal_force(face, state, history))
        for got in (lane, _force(face, state, history)):
            np.testing.assert_allclose(got, eager, ROUNDOFF, ROUNDOFF * np.abs(eager).max())
