"""From an experiment and its compression to the discrete problem: a layer and a sample in contact."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..mechanics.boundary import Bodies
from ..mechanics.contact_body import RigidPlate, RigidSurface
from ..mechanics.contact_face import ContactFace
from ..mechanics.contact_pair import SOFT, ContactPair
from ..mechanics.face import FaceRule
from ..mechanics.internal import layer_body, typical
from ..model import AbstractMaterial, BlockMesh, Bonded, Compression, Contact, Experiment, LayerMesh, Roller, Side
from .equations import State
from .equilibrium import Problem
from .in_plane_hold import drift_modes
from .stack import Stack
from .supports import Supports
from .tangent import VOLUME_GUARD

# Pressure of every contact at the initial guess, over the lower body's shear modulus: enough for laws of zero initial
# stiffness to have some, too little to deform the bodies.
_TOUCH = 1e-3

_KINDS = {Bonded: "bonded", Roller: "roller", Contact: "contact"}
_PLATE_KINDS = {Bonded: "bonded", Roller: "uz", Contact: "contact"}


def discretise_experiment(
    experiment: Experiment, load: Compression, start: Compression | None, rule: FaceRule
) -> Stack | Problem:
    """Build the discrete problem: a layer and a sample in contact, or one block of both where they are bonded.

    Args:
        experiment: The experiment.
        load: Its compression at load fraction 1.
        start: Its compression at load fraction 0; None for bodies that just touch.
        rule: Quadrature of contact.
    """
    layer, sample = single_bodies(experiment, load, start, rule)
    if isinstance(experiment.interface, Bonded):
        return _joined(experiment, layer, sample)
    lower, upper, soft = experiment.layer_mesh(), experiment.sample_mesh(), experiment.layer.material
    exact = experiment.interface.law.exact
    # The sample's face is curved and deformable: more contact points than nodes of the layer's face over-constrain it.
    face = _face(experiment.interface, RigidSurface(None, None), True, lower, soft, "nodes" if exact else rule)
    assert face is not None
    between = 1.0 / (1.0 / face.stiffness + 1.0 / _stiffness(upper, experiment.sample_material()))
    x0, x1, y0, y1 = (side == "free" for side in experiment.sides)
    pair = ContactPair(
        face=dataclasses.replace(face, stiffness=between),
        spacing=jnp.stack(upper.spacing),
        lower_spacing=jnp.stack(lower.spacing),
        soft=SOFT * _confined(soft) / jnp.mean(lower.thickness) * lower.layers,
        rims=(x0, x1, y0, y1),
    )
    return Stack(lower=layer, upper=sample, pair=pair, viscosity=jnp.zeros((), layer.positions.dtype))


def single_bodies(
    experiment: Experiment, load: Compression, start: Compression | None, rule: FaceRule
) -> tuple[Problem, Problem]:
    """Build layer and sample, each between its rigid surface and the other; arguments as in `discretise_experiment`."""
    lower, upper = experiment.layer_mesh(), experiment.sample_mesh()
    soft, material = experiment.layer.material, experiment.sample_material()
    approach = jnp.zeros_like(load.approach) if start is None else start.approach
    plate = RigidPlate(experiment.plate_height - approach, experiment.plate_height - load.approach)
    window = _face(experiment.window, RigidSurface(None, None), False, lower, soft, rule)
    pressed = _face(experiment.plate, plate, True, upper, material, rule)
    interface, sides = _KINDS[type(experiment.interface)], experiment.sides
    has_spring = experiment.hold is not None
    supports = Supports(_KINDS[type(experiment.window)], interface, sides, has_spring)
    layer = _body(experiment, lower, soft, experiment.element[0], supports, Bodies(window, None), None)
    move = None
    if not isinstance(experiment.plate, Contact):
        top = jnp.ones_like(upper.heights[-1])
        move = (-approach * top, -load.approach * top)
    supports = Supports(interface, _PLATE_KINDS[type(experiment.plate)], sides, has_spring)
    sample = _body(experiment, upper, material, experiment.element[1], supports, Bodies(None, pressed), move)
    return layer, sample


def touching(problem: Stack | Problem, state: State, increment: Array) -> State:
    """Build a fictitious previous state, from which extrapolation brings the bodies into contact."""
    stacked = isinstance(problem, Stack)
    lower = problem.lower if stacked else problem
    faces = (lower.contacts.window, problem.pair.face) if stacked else (lower.contacts.window,)
    pressure, shift = _TOUCH * lower.body.shear, jnp.zeros((), state.fraction.dtype)
    before = []
    for face, u in zip(faces, state.u if stacked else (state.u,), strict=True):
        if face is not None:
            law = face.own_contact.law
            shift = shift + law.zero_pressure_clearance - law.clearance_at(pressure, face.stiffness)
        before.append(jnp.concatenate([u[:2], u[2:] + shift / increment]))
    earlier = tuple(before) if stacked else before[0]
    return eqx.tree_at(lambda s: [s.u, s.fraction], state, [earlier, state.fraction - 1.0])


def _joined(experiment: Experiment, layer: Problem, sample: Problem) -> Problem:
    """Combine a layer and a sample with common nodes into one block."""
    window, plate = layer.contacts.window, sample.contacts.sample
    if window is not None and plate is not None:
        # They may be evaluated together, with one scale of hard contact: that of the softer body.
        softer = jnp.minimum(window.stiffness, plate.stiffness)
        window, plate = (dataclasses.replace(face, stiffness=softer) for face in (window, plate))
    supports = Supports(layer.supports.window, sample.supports.interface, experiment.sides, layer.supports.spring)
    return _body(
        experiment,
        experiment.bonded_mesh(),
        experiment.bonded_material(),
        experiment.element[0],
        supports,
        Bodies(window, plate),
        sample.imposed,
    )


def _body(
    experiment: Experiment,
    mesh: LayerMesh | BlockMesh,
    material: AbstractMaterial,
    element: str,
    supports: Supports,
    contacts: Bodies,
    imposed: tuple[Array, Array] | None,
) -> Problem:
    X = mesh.positions()
    spring = None
    if experiment.hold is not None:
        nodes = X[0, 0].size
        spring = jnp.broadcast_to(experiment.hold / nodes, X.shape[2:])
    return Problem(
        body=layer_body(mesh, material, element),
        low_order=None,
        positions=X,
        contacts=contacts,
        dead=None,
        imposed=imposed,
        spring=spring,
        viscosity=jnp.zeros((), X.dtype),
        drift_modes=drift_modes(X, supports),
        supports=supports,
    )


def _face(
    side: Side,
    surface: RigidSurface | RigidPlate,
    above: bool,
    mesh: LayerMesh | BlockMesh,
    material: AbstractMaterial,
    rule: FaceRule,
) -> ContactFace | None:
    """Build the contact of a face, which starts at the zero-pressure clearance of its law; None without contact."""
    if not isinstance(side, Contact):
        return None
    return ContactFace(
        contact=side,
        surface=surface,
        offset=side.law.zero_pressure_clearance,
        imposed=None,
        element_size=mesh.element_size,
        stiffness=_stiffness(mesh, material),
        above=above,
        rule=rule,
    )


def _stiffness(mesh: LayerMesh | BlockMesh, material: AbstractMaterial) -> Array:
    """Compute the stiffness of an element per area [MPa/mm], the scale of hard contact (`discretise`)."""
    height = jnp.mean(mesh.thickness) / mesh.layers
    flatness = jnp.minimum(1.0, height / mesh.element_size)
    return flatness**2 * _confined(material) / height


def _confined(material: AbstractMaterial) -> Array:
    """Compute the confined modulus [MPa], with no more than `VOLUME_GUARD` shear moduli for the bulk modulus."""
    bulk = jnp.minimum(material.bulk, VOLUME_GUARD * material.shear)
    return typical(jnp.asarray(bulk + 4.0 / 3.0 * material.shear))
