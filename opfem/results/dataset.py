"""`to_xarray`: a solution as labelled data with units, and the record of how it was made.

Last stage of the chain; what is written to files and drawn starts from this dataset.
"""

import json
from typing import Any

import jax
import numpy as np
import xarray as xr

from .._checks import concrete
from ..inverse import FitStatus, TractionFit
from ..model import Imprint
from ..solvers import CONVERGED, RESULTS, ExperimentSolution, FaceResult, Solution
from ..solvers.solution import OPEN, is_failure
from .bodies import SAMPLE_NODES, interior_variables, sample_coordinates, sample_record, sample_variables
from .fields import node_areas, pressure_image, under_pixels
from .interior import layer_fields
from .labels import NODES, Variable, variable
from .provenance import describe, inputs_hash, steps_as_json, versions

IMAGE = ("y_image", "x_image")
NOT_CONVERGED = -1
"""Contact status where the solve failed."""

STATS = {
    "newton_steps": ("1", "Newton steps of all load increments"),
    "krylov_steps": ("1", "preconditioner applications of all linear solves"),
    "increments": ("1", "load increments accepted"),
    "attempts": ("1", "load increments tried"),
    "residual": ("1", "unbalanced force over contact force"),
    "load_fraction": ("1", "load fraction reached"),
    "strain_energy": ("N mm", "strain energy of the layer"),
    "friction_dissipation": ("N mm", "energy dissipated by friction"),
    "force_sample": ("N", "force of the sample on the layer"),
    "force_window": ("N", "force of the window on the layer"),
    "force_hold": ("N", "force of the in-plane hold on the layer"),
    "moment_sample": ("N mm", "moment of the sample on the layer about the origin"),
    "moment_window": ("N mm", "moment of the window on the layer about the origin"),
    "moment_hold": ("N mm", "moment of the in-plane hold on the layer about the origin"),
    "work_sample": ("N mm", "work of the sample on the layer"),
    "work_window": ("N mm", "work of the window on the layer"),
    "approach": ("mm", "approach of sample and layer that the contact law itself causes"),
    "max_penetration": ("mm", "largest penetration"),
    "side_overlap": ("mm", "how far sides of the layer reach into the window or the sample"),
    "min_volume_ratio": ("1", "smallest volume ratio J in the layer"),
    "min_stretch": ("1", "smallest principal stretch in the layer, volume change taken out"),
    "max_stretch": ("1", "largest principal stretch in the layer, volume change taken out"),
    "beyond_calibration": (
        "1",
        "principal stretch over the largest the material was calibrated for, or below its least",
    ),
    "unstable_stretch": ("1", "stretch reached from which on the material law is unstable, 0: none"),
    "increment": ("s", "shortest time increment"),
    "kinetic_ratio": ("1", "largest kinetic over all energy after the first tenth of the load"),
    "energy_drift": ("1", "largest energy missing from the balance over all energy"),
    "output_time": ("s", "time of the outputs"),
    "output_increment": ("s", "time increment before each output"),
    "energy_strain": ("N mm", "strain energy at every output"),
    "energy_kinetic": ("N mm", "kinetic energy at every output"),
    "energy_contact": ("N mm", "energy stored and lost in contact until every output"),
    "energy_friction": ("N mm", "energy dissipated by friction until every output"),
    "energy_viscous": ("N mm", "energy dissipated by bulk viscosity until every output"),
    "energy_damping": ("N mm", "energy dissipated by damping until every output"),
    "energy_external": ("N mm", "work done by the load until every output"),
    "energy_total": ("N mm", "all energies less the work done, at every output"),
}
FIT_STATS = {
    "forward_solves": ("1", "solves under a trial traction"),
    "gauss_newton_steps": ("1", "Gauss–Newton steps accepted"),
    "inner_iterations": ("1", "products with the Jacobian and with its transpose, of all Gauss–Newton steps"),
    "posterior_iterations": ("1", "the same of all draws of the posterior"),
    "draws": ("1", "draws of the posterior that standard deviations come from"),
    "std_error": ("1", "relative standard error of the standard deviations"),
    "representation_rms": ("mm", "root mean square of what the map has beyond mesh-spaced splines"),
    "misfit_rms": ("mm", "root mean square of interface minus measured surface"),
}
EXPERIMENT_STATS = {
    "strain_energy": ("N mm", "strain energy of layer and sample"),
    "force_plate": ("N", "force of the plate on the sample"),
    "force_hold": ("N", "force of the in-plane hold on layer and sample"),
    "work_plate": ("N mm", "work of the plate on the sample"),
    "min_volume_ratio": ("1", "smallest volume ratio J in layer and sample"),
}


def to_xarray(solution: Solution | ExperimentSolution | TractionFit, *, interior: bool = False) -> xr.Dataset:
    """Label a solution, or a fit: dims, positions, units, and how it was made.

    Everything is in mm, N and MPa. Interface nodes are `y`, `x`; `x_current` and `y_current` say where
    they have moved. `thickness`, `compression` (1 - L1/L0) and `pressure_image` are on the pixels of the load's map,
    NaN where no interface point lies under a pixel. Fields of a failed solve are NaN, its `contact_status` -1.
    Of an experiment these are the layer's, on pixels at its nodes; names of the sample's fields begin with
    `sample_`, of those at the plate with `plate_`, on nodes `y_sample`, `x_sample`.

    Args:
        solution: One solution or fit, outside jit. A fit adds `pressure_std`, `normal_std`, `residual` and what
            says how well it explains the map.
        interior: Also take `stress`, `green_strain` and `energy_density` at every node, as `layer_fields`
            recovers them.

    Raises:
        ValueError: For a traced or a batched solution.

    Example:
        >>> import jax.numpy as jnp
        >>> import opfem as op
        >>> def stress_map(solution):
        ...     data = op.to_xarray(solution)
        ...     return 1e3 * data.pressure  # kPa
    """
    if isinstance(solution, TractionFit):
        return (
            to_xarray(solution.solution, interior=interior).assign(_fit(solution)).assign_attrs(_fit_record(solution))
        )
    _require_one(solution)
    failed = status_name(solution) not in CONVERGED
    variables = {
        **_volume(solution),
        **_face("", "at the sample", solution.interface, _surface(solution, -1), failed),
        **_face("window_", "at the window", solution.window, _surface(solution, 0), failed),
        **_image(solution),
        **_stats(solution.stats, STATS if isinstance(solution, Solution) else STATS | EXPERIMENT_STATS),
        **(interior_variables(layer_fields(solution)) if interior else {}),
    }
    coordinates = _coordinates(solution)
    if isinstance(solution, ExperimentSolution):
        plate = np.asarray(solution.sample.positions[:, -1] + solution.sample.displacement[:, -1])
        variables |= _face("plate_", "at the plate", solution.plate, plate, failed, "sample", SAMPLE_NODES[1:])
        variables |= sample_variables(solution, interior)
        coordinates |= sample_coordinates(solution)
    if interior or isinstance(solution, ExperimentSolution):
        coordinates["direction"] = (("direction",), np.array(["x", "y", "z"]), {"long_name": "direction of a face"})
    return xr.Dataset(variables, coords=coordinates, attrs=_record(solution))


def status_name(solution: Solution | ExperimentSolution) -> str:
    """Name how a solve ended, as a member of `RESULTS`."""
    # Equinox offers no other way from an item to its name.
    names = RESULTS._name_to_item
    return next(name for name, item in names.items() if bool(item == solution.result))


def status_message(solution: Solution | ExperimentSolution) -> str:
    """Say in words how a solve ended; empty when all is well."""
    message = RESULTS[solution.result]
    if status_name(solution) == "material_unstable":
        low, high, limit = (float(solution.stats[f"{name}_stretch"]) for name in ("min", "max", "unstable"))
        message += f" Stretches reach from {low:.3g} to {high:.3g}; from {limit:.3g} on it is unstable."
    elif touches_nowhere(solution):
        message = (
            "Nothing touches: the layer is unloaded, and every pressure is zero. Is the map thicker than L0, or in "
            "another unit?"
        )
    return message


def touches_nowhere(solution: Solution | ExperimentSolution) -> bool:
    """Tell whether an imprint has reached its full depth without contact anywhere."""
    imprinted = isinstance(solution.load, Imprint) and not bool(is_failure(solution.result))
    return imprinted and not np.any(np.asarray(solution.contact_status) != OPEN)


def _require_one(solution: Solution | ExperimentSolution) -> None:
    if any(concrete(leaf) is None for leaf in jax.tree.leaves(solution)):
        raise ValueError("to_xarray needs known numbers, got a traced solution. Call it outside jit, grad and vmap.")
    if solution.displacement.ndim != 4:
        raise ValueError(
            "to_xarray takes one solution with displacement (3, nz+1, ny+1, nx+1), got shape "
            f"{solution.displacement.shape}. Pick one: jax.tree.map(lambda leaf: leaf[0], solutions)."
        )


def _coordinates(solution: Solution | ExperimentSolution) -> dict[str, Variable]:
    X = np.asarray(solution.positions[:2, -1])
    current = X + np.asarray(solution.displacement[:2, -1])
    x, y = X[0, 0], X[1, :, 0]
    layers = solution.positions.shape[1] - 1
    grid = solution.thickness
    return {
        "x": variable(("x",), x, "mm", "reference position along image columns"),
        "y": variable(("y",), y, "mm", "reference position along image rows"),
        "z": variable(("z",), np.arange(layers + 1) / layers, "1", "height over unloaded thickness, 0 at the window"),
        "component": (("component",), np.array(["x", "y", "z"]), {"long_name": "component of a vector"}),
        "lateral": (("lateral",), np.array(["x", "y"]), {"long_name": "component of an in-plane vector"}),
        "x_current": variable(NODES, current[0], "mm", "current position of interface nodes along image columns"),
        "y_current": variable(NODES, current[1], "mm", "current position of interface nodes along image rows"),
        "x_element": variable(("x_element",), 0.5 * (x[1:] + x[:-1]), "mm", "reference element centres along x"),
        "y_element": variable(("y_element",), 0.5 * (y[1:] + y[:-1]), "mm", "reference element centres along y"),
        "x_image": variable(("x_image",), grid.x, "mm", "position of image columns"),
        "y_image": variable(("y_image",), grid.y, "mm", "position of image rows"),
    }


def _surface(solution: Solution | ExperimentSolution, level: int) -> np.ndarray:
    """Locate the nodes of the layer's lower (0) or upper (-1) face where they are now [mm]."""
    return np.asarray(solution.positions[:, level] + solution.displacement[:, level])


def _volume(solution: Solution | ExperimentSolution) -> dict[str, Variable]:
    L0, u = np.asarray(solution.positions[2, -1]), np.asarray(solution.displacement[2])
    return {
        "displacement": variable(("component", "z", *NODES), solution.displacement, "mm", "displacement"),
        "unloaded_thickness": variable(NODES, L0, "mm", "unloaded thickness L0"),
        "nominal_strain": variable(
            NODES, (u[-1] - u[0]) / L0, "1", "nominal strain along z, mean over the thickness, tension positive"
        ),
        "stress_zz": variable(
            ("y_element", "x_element"),
            solution.stress_zz,
            "MPa",
            "Cauchy stress zz, mean over the top element, tension positive",
        ),
    }


def _face(
    prefix: str,
    where: str,
    face: FaceResult,
    current: np.ndarray,
    failed: bool,
    body: str = "layer",
    nodes: tuple[str, ...] = NODES,
) -> dict[str, Variable]:
    status = np.full(face.status.shape, NOT_CONVERGED) if failed else np.asarray(face.status)
    return {
        f"{prefix}pressure": variable(
            nodes, face.pressure, "MPa", f"contact pressure {where} on the current area, compression positive"
        ),
        f"{prefix}traction": variable(
            ("component", *nodes), face.traction, "MPa", f"force on the {body} {where} per reference area"
        ),
        f"{prefix}slip": variable(("lateral", *nodes), face.slip, "mm", f"tangential slip {where}"),
        f"{prefix}node_area": variable(
            nodes, node_areas(*current), "mm2", f"current area that belongs to each node {where}"
        ),
        f"{prefix}contact_status": variable(
            nodes,
            status.astype(np.int8),
            "1",
            f"contact status {where}",
            flag_values=np.array([NOT_CONVERGED, 0, 1, 2], np.int8),
            flag_meanings="not_converged open stick slip",
        ),
    }


def _image(solution: Solution | ExperimentSolution) -> dict[str, Variable]:
    grid = solution.thickness
    thickness = np.where(grid.mask, np.nan, grid.values)
    X, place = np.asarray(solution.positions[:, -1]), np.meshgrid(grid.x, grid.y)
    L0 = under_pixels(X[2], X[:2], np.zeros_like(X[:2]), *place)
    images = {
        "thickness": variable(IMAGE, thickness, "mm", "computed thickness of the loaded layer"),
        "compression": variable(IMAGE, 1.0 - thickness / L0, "1", "compression of the layer, 1 - L1/L0"),
        "pressure_image": variable(
            IMAGE, pressure_image(solution), "MPa", "contact pressure at the sample under each pixel"
        ),
    }
    if isinstance(solution.load, Imprint):
        given = solution.load.thickness
        images["imposed_thickness"] = variable(IMAGE, given.values, "mm", "thickness map that was pressed in")
        images["missing"] = variable(IMAGE, given.mask, "1", "pixels of that map that hold no measured data")
    return images


def _fit(fit: TractionFit) -> dict[str, Variable]:
    return {
        "pressure_std": variable(NODES, fit.pressure_std, "MPa", "posterior standard deviation of the pressure"),
        "mesh_std": variable(NODES, fit.mesh_std, "MPa", "mesh error of the pressure, included in pressure_std"),
        "normal_std": variable(
            NODES, fit.normal_std, "MPa", "posterior standard deviation of the normal traction per reference area"
        ),
        "residual": variable(
            NODES, fit.residual, "mm", "interface minus measured surface at the places of the unloaded nodes"
        ),
        "chi2": variable((), fit.chi2, "1", "sum of squared misfits over their noise"),
        "effective_dof": variable((), fit.effective_dof, "1", "degrees of freedom that the map determines"),
        "observed": variable((), fit.observed, "1", "independent numbers of the map on the mesh's splines"),
        "reduced_chi2": variable((), fit.reduced_chi2, "1", "chi2 over the degrees of freedom left"),
        "resolution_points": variable(
            ("resolution_point", "lateral"), fit.resolution_points, "mm", "where the resolution was computed"
        ),
        "resolution_width": variable(
            ("resolution_point",), fit.resolution_width, "mm", "full width at half maximum of the resolution kernel"
        ),
        **_numbers(fit),
        **_stats(fit.stats, FIT_STATS),
    }


def _numbers(fit: TractionFit) -> dict[str, Variable]:
    """Fitted numbers of the experiment, in their own units."""
    if not fit.objective.parameters:
        return {}
    values, intervals = fit.numbers, fit.number_intervals()
    return {
        "fitted_number": (("number",), np.array(list(values)), {"long_name": "name of a fitted number"}),
        "fitted_value": (("number",), np.array([float(v) for v in values.values()]), {"long_name": "fitted value"}),
        "fitted_interval": (
            ("number", "bound"),
            np.array([intervals[name] for name in values]),
            {"long_name": "bounds of the 95 % interval of a fitted number"},
        ),
    }


def _fit_record(fit: TractionFit) -> dict[str, Any]:
    names = FitStatus._name_to_item
    return {
        "fit_status": next(name for name, item in names.items() if bool(item == fit.result)),
        "fit_message": FitStatus[fit.result],
        "prior": json.dumps(describe(fit.prior)),
    }


def _stats(stats: dict[str, Any], labels: dict[str, tuple[str, str]]) -> dict[str, Variable]:
    labelled: dict[str, Variable] = {}
    for name, value in stats.items():
        values = np.asarray(value)
        dims = ("component",) if values.shape == (3,) else tuple(f"{name}_{axis}" for axis in range(values.ndim))
        if name.startswith(("energy_", "output_")) and values.ndim == 1:
            dims = ("output",)
        unit, long_name = labels.get(name, (None, name.replace("_", " ")))
        labelled[name] = (dims, values, {"long_name": long_name} | ({} if unit is None else {"units": unit}))
    return labelled


def _record(solution: Solution | ExperimentSolution) -> dict[str, Any]:
    """Collect what made this result; only types that netCDF stores."""
    load = solution.load
    problem = solution.palpation if isinstance(solution, Solution) else solution.experiment
    record = {
        "title": "Stress on the sample from the thickness of a soft layer",
        "conventions": "mm, N, MPa; tension positive, contact pressure positive in compression; x along image "
        "columns, y along image rows, z from the window to the sample",
        "status": status_name(solution),
        "status_message": status_message(solution),
        "extent": np.asarray(problem.extent),
        "sides": json.dumps(dict(zip(("x0", "x1", "y0", "y1"), problem.sides, strict=True))),
        "layer": json.dumps(describe(problem.layer)),
        "window": json.dumps(describe(problem.window)),
        "sample": json.dumps(describe(problem.sample)),
        "load": json.dumps(describe(load)),
        **versions(),
    }
    if isinstance(solution, Solution):
        record |= {"element": solution.palpation.element, "elements": np.array(solution.palpation.elements)}
        record["inputs_sha256"] = inputs_hash(palpation=solution.palpation, load=load)
    else:
        record |= sample_record(solution)
    if isinstance(load, Imprint):
        record["thickness_steps"] = steps_as_json(load.thickness)
    return record
