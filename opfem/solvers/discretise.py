"""From a palpation and a load to the discrete problem: surfaces, supports and dead forces."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._checks import concrete
from ..mechanics.boundary import Bodies, is_side, take
from ..mechanics.contact_body import ImposedPressure, RigidSurface
from ..mechanics.contact_face import ContactFace
from ..mechanics.face import FaceRule, area_vector, gather_face, node_shares, size, surface_tangents, tributary_area
from ..mechanics.internal import ELEMENT_FORMS, layer_body
from ..model import (
    Bonded,
    Compression,
    Contact,
    Displacement,
    Experiment,
    HeightField,
    Imprint,
    LayerMesh,
    Load,
    Palpation,
    Roller,
    Side,
    Traction,
    height_field,
)
from ..model.plausible import check_against_layer, check_approach
from .equilibrium import Problem
from .in_plane_hold import drift_modes
from .supports import Supports
from .tangent import VOLUME_GUARD


def discretise(palpation: Palpation, load: Load, start: Load | None, rule: FaceRule) -> Problem:
    """Build the discrete problem.

    Args:
        palpation: The experiment.
        load: The load at load fraction 1.
        start: The load at fraction 0; None for the unloaded layer.
        rule: Quadrature of contact.
    """
    mesh = palpation.mesh()
    material = palpation.layer.material
    X = mesh.positions()
    # Penalty of hard contact: uniaxial-strain stiffness of an element, with a bounded bulk modulus and lower for flat
    # elements. Much stiffer contact (nearly incompressible, or flat and partly lifted off) cycles between open and
    # closed.
    bulk = jnp.minimum(material.bulk, VOLUME_GUARD * material.shear)
    height = jnp.mean(mesh.thickness) / mesh.layers
    flatness = jnp.minimum(1.0, height / mesh.element_size)
    stiffness = flatness**2 * (bulk + 4.0 / 3.0 * material.shear) / height

    nx, ny, nz = mesh.elements
    cells, _ = ELEMENT_FORMS[palpation.element]
    shares = node_shares(cells, (ny, nx))
    if shares is not None:  # contact of triangles is integrated at their nodes
        rule = "nodes"
        shares = jnp.asarray(shares.reshape(4, -1), X.dtype)

    def face(
        contact, surface: RigidSurface, above: bool, offset: ArrayLike = 0.0, imposed=None, rule: FaceRule = rule
    ) -> ContactFace:
        offset = jnp.asarray(offset, X.dtype)
        if contact.law.exact and surface.end is not None:
            rule = "nodes"
        return ContactFace(contact, surface, offset, imposed, mesh.element_size, stiffness, above, rule, shares=shares)

    def with_sides(face: ContactFace | None) -> ContactFace | None:
        free = palpation.side_contact and palpation.sides != ("roller",) * 4
        if face is None or face.imposed is not None or not free:
            return face
        sides = jnp.asarray(is_side((nz, ny, nx)))
        whole = None if shares is None else jnp.pad(shares, ((0, 0), (0, sides.size - ny * nx)), constant_values=1.0)
        return dataclasses.replace(face, sides=sides, shares=whole)

    plane = RigidSurface(None, None)
    window = face(palpation.window, plane, False) if isinstance(palpation.window, Contact) else None
    sample = dead = imposed = None
    if isinstance(load, Imprint):
        offset = _contact(palpation.sample).law.zero_pressure_clearance
        sample = face(palpation.sample, _imprint_surface(palpation, mesh, load, start), True, offset)
    elif isinstance(load, Traction):
        area = tributary_area(X[:, -1], cells)
        first, last = (_traction(end if isinstance(end, Traction) else None, mesh) for end in (start, load))
        dead = (first * area, last * area)
        foundation = _foundation(load, start)
        if load.lateral is None or foundation is not None:
            at, xi, eta = surface_tangents(take(X, "sample", with_sides=False), "nodes")
            start_normal, end_normal = (gather_face(-end[2:]).reshape(4, -1) for end in (first, last))
            rest = None if foundation is None else at[2]
            pressure = ImposedPressure(start_normal, end_normal, size(area_vector(xi, eta)), rest, foundation)
            contact = _contact(palpation.sample)
            if load.lateral is not None:
                contact = dataclasses.replace(contact, friction=0.0)
            sample = face(contact, plane, True, imposed=pressure, rule="nodes")
    else:
        first, last = (_displacement(end if isinstance(end, Displacement) else None, mesh) for end in (start, load))
        imposed = (first, last)
    spring = None
    if palpation.hold is not None:
        share = tributary_area(X[:, 0], cells)
        spring = palpation.hold * share / jnp.sum(share)
    body = layer_body(mesh, material, palpation.element)
    # Multigrid needs the stencil of hexahedra, which precondition quadratic elements.
    low_order = layer_body(mesh, material, "full") if palpation.element == "tet10" else None
    contacts = Bodies(with_sides(window), with_sides(sample))
    supports = _supports(palpation, load)
    return Problem(
        body=body,
        low_order=low_order,
        positions=X,
        contacts=contacts,
        dead=dead,
        imposed=imposed,
        spring=spring,
        viscosity=jnp.zeros((), X.dtype),
        drift_modes=drift_modes(X, supports),
        supports=supports,
    )


def _contact(side: Side) -> Contact:
    assert isinstance(side, Contact)  # checked by check_compatible
    return side


def check_compatible(
    palpation: Palpation | Experiment, load: Load | Compression, start: Load | Compression | None
) -> None:
    """Raise ValueError where load and sample, or map and layer, are incompatible; warn where this is likely."""
    if isinstance(palpation, Experiment) or isinstance(load, Compression):
        _check_experiment(palpation, load, start)
        return
    if not isinstance(load, (Imprint, Traction, Displacement)):
        raise ValueError(f"load must be Imprint, Traction or Displacement, got {type(load).__name__}.")
    if start is not None and type(start) is not type(load):
        raise ValueError(
            f"A solve continues with the same kind of load: expected {type(start).__name__} as in start, "
            f"got {type(load).__name__}."
        )
    name = type(load).__name__
    if isinstance(load, (Imprint, Traction)) and not isinstance(palpation.sample, Contact):
        raise ValueError(
            f"{name} needs sample=Contact(law, friction), got sample={type(palpation.sample).__name__}(). "
            "For a prescribed interface use Displacement."
        )
    if isinstance(load, Displacement) and isinstance(palpation.sample, Bonded) and load.lateral == "free":
        raise ValueError(
            "Displacement(lateral='free') lets the interface slide, but the sample is Bonded(). "
            "Pass lateral='fixed', or sample=Roller()."
        )
    if isinstance(load, Displacement) and isinstance(palpation.sample, Contact):
        friction = concrete(palpation.sample.friction)
        if load.lateral == "free" and (friction is None or np.any(friction != 0)):
            raise ValueError(
                "Displacement(lateral='free') leaves the interface without friction, but sample.friction [-] is not "
                "zero. Pass sample=Roller(), or press the shape in with Imprint."
            )
    if isinstance(load, Imprint):
        check_against_layer("Imprint.thickness", load.thickness, palpation.layer.thickness, palpation.extent, 4)


def _check_experiment(experiment: Any, load: Any, start: Any) -> None:
    if not isinstance(experiment, Experiment):
        raise ValueError("Compression presses an Experiment. A Palpation takes Imprint, Traction or Displacement.")
    if not isinstance(load, Compression):
        raise ValueError(f"An Experiment takes Compression(approach) [mm], got {type(load).__name__}.")
    if start is not None and not isinstance(start, Compression):
        raise ValueError(f"start must be a solved Experiment, got a solution under {type(start).__name__}.")
    check_approach(load.approach, experiment.plate_height)


def _supports(palpation: Palpation, load: Load) -> Supports:
    window = {Bonded: "bonded", Roller: "roller", Contact: "contact"}[type(palpation.window)]
    if isinstance(load, Displacement):
        interface = "bonded" if load.lateral == "fixed" else "uz"
    else:
        interface = "contact" if isinstance(load, Imprint) else "traction"
    return Supports(window, interface, palpation.sides, palpation.hold is not None)


def _imprint_surface(palpation: Palpation, mesh: LayerMesh, load: Imprint, start: Load | None) -> RigidSurface:
    nx, ny, _ = mesh.elements
    hx, hy = mesh.spacing
    # The rigid body reaches half a field past the layer; beyond, it continues at its edge value.
    beyond = (nx // 2 + 1, ny // 2 + 1)
    columns = (jnp.arange(nx + 1 + 2 * beyond[0]) - beyond[0]) * hx
    rows = (jnp.arange(ny + 1 + 2 * beyond[1]) - beyond[1]) * hy
    y, x = jnp.meshgrid(rows, columns, indexing="ij")
    origin, spacing = jnp.stack([columns[0], rows[0]]), jnp.stack([hx, hy])

    def surface(values: Array) -> HeightField:
        return height_field(values, origin, spacing, load.interpolation)

    unloaded = palpation.layer.thickness_at(x, y)
    first = start.thickness.sample(x, y) if isinstance(start, Imprint) else unloaded
    return RigidSurface(surface(first), surface(load.thickness.sample(x, y)))


def _traction(load: Traction | None, mesh: LayerMesh) -> Array:
    shape = mesh.thickness.shape
    if load is None:
        return jnp.zeros((3, *shape), mesh.thickness.dtype)
    normal = _on_nodes("Traction.normal", "MPa", load.normal, shape)
    lateral = jnp.zeros((2, *shape), normal.dtype)
    if load.lateral is not None:
        if load.lateral.shape != (2, *shape):
            raise ValueError(f"Traction.lateral [MPa] must be {(2, *shape)}, got {load.lateral.shape}.")
        lateral = load.lateral
    return jnp.concatenate([lateral, -normal[None]])


def _foundation(load: Traction, start: Load | None) -> tuple[Array, Array] | None:
    """Return the stiffness of the elastic foundation [MPa/mm] at both ends; None without foundation."""
    first = start.stiffness if isinstance(start, Traction) else load.stiffness
    if first is None and load.stiffness is None:
        return None
    none = jnp.zeros_like(load.normal, shape=())
    return none if first is None else first, none if load.stiffness is None else load.stiffness


def _displacement(load: Displacement | None, mesh: LayerMesh) -> Array:
    if load is None:
        return jnp.zeros_like(mesh.thickness)
    return _on_nodes("Displacement.uz", "mm", load.uz, mesh.thickness.shape)


def _on_nodes(field: str, unit: str, values: Array, shape: tuple[int, ...]) -> Array:
    if values.ndim and values.shape != shape:
        raise ValueError(
            f"{field} [{unit}] must be a number or interface nodes (ny+1, nx+1) = {shape}, got {values.shape}."
        )
    return jnp.broadcast_to(values, shape)
