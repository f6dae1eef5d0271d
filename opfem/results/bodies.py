"""What `to_xarray` labels inside bodies, and of an experiment's sample: nodes, displacement, stress in elements."""

import json
from typing import Any

import numpy as np

from ..solvers import ExperimentSolution
from .interior import LayerFields, sample_fields
from .labels import NODES, Variable, variable
from .provenance import describe, inputs_hash

SAMPLE_NODES = ("z_sample", "y_sample", "x_sample")
SAMPLE_ELEMENTS = ("z_sample_element", "y_sample_element", "x_sample_element")
LAYER_ELEMENTS = ("z_element", "y_element", "x_element")
_TENSOR = ("component", "direction")


def interior_variables(
    fields: LayerFields, prefix: str = "", nodes: tuple[str, ...] = ("z", *NODES)
) -> dict[str, Variable]:
    """Label stress, strain and energy at the nodes of a body.

    Args:
        fields: Of the body.
        prefix: Of the names.
        nodes: Dims of the body's nodes.
    """
    tensor = (*_TENSOR, *nodes)
    return {
        f"{prefix}stress": variable(tensor, fields.at_nodes(fields.stress), "MPa", "Cauchy stress, tension positive"),
        f"{prefix}green_strain": variable(tensor, fields.at_nodes(fields.green_strain), "1", "Green–Lagrange strain"),
        f"{prefix}energy_density": variable(
            nodes, fields.at_nodes(fields.energy_density), "MPa", "strain energy per reference volume"
        ),
    }


def sample_variables(solution: ExperimentSolution, interior: bool) -> dict[str, Variable]:
    """Label what is known of the sample, and the stress in the elements of both bodies.

    Args:
        solution: One solution, outside jit.
        interior: Whether to recover stress, strain and energy at the sample's nodes.
    """
    sample = solution.sample
    shear = np.asarray(solution.experiment.sample_material().shear)
    stress = "Cauchy stress, mean over an element, tension positive"
    return {
        "sample_displacement": variable(
            ("component", *SAMPLE_NODES), sample.displacement, "mm", "displacement of the sample"
        ),
        "sample_height": variable(SAMPLE_NODES, sample.positions[2], "mm", "unloaded height over the window"),
        "sample_element_stress": variable((*_TENSOR, *SAMPLE_ELEMENTS), sample.stress, "MPa", stress),
        "sample_shear_modulus": variable(
            SAMPLE_ELEMENTS, np.broadcast_to(shear, sample.stress.shape[2:]), "MPa", "shear modulus at rest"
        ),
        "layer_element_stress": variable((*_TENSOR, *LAYER_ELEMENTS), solution.layer.stress, "MPa", stress),
        **(interior_variables(sample_fields(solution), "sample_", SAMPLE_NODES) if interior else {}),
    }


def sample_coordinates(solution: ExperimentSolution) -> dict[str, Variable]:
    """Label where the sample's nodes and elements lie.

    Args:
        solution: One solution, outside jit.
    """
    X = np.asarray(solution.sample.positions)
    x, y = X[0, 0, 0], X[1, 0, :, 0]
    return {
        "x_sample": variable(("x_sample",), x, "mm", "reference position of the sample's nodes along image columns"),
        "y_sample": variable(("y_sample",), y, "mm", "reference position of the sample's nodes along image rows"),
        "x_sample_element": variable(
            ("x_sample_element",), 0.5 * (x[1:] + x[:-1]), "mm", "reference centres of the sample's elements along x"
        ),
        "y_sample_element": variable(
            ("y_sample_element",), 0.5 * (y[1:] + y[:-1]), "mm", "reference centres of the sample's elements along y"
        ),
    }


def sample_record(solution: ExperimentSolution) -> dict[str, Any]:
    """Collect what made an experiment's solution beside what made a palpation's; only types that netCDF stores.

    Args:
        solution: One solution, outside jit.
    """
    experiment = solution.experiment
    return {
        "title": "Virtual experiment: a layer and a deformable sample between window and plate",
        "element": ", ".join(dict.fromkeys(experiment.element)),
        "elements": np.array(experiment.layer_elements),
        "sample_elements": np.array(experiment.sample_elements),
        "interface": json.dumps(describe(experiment.interface)),
        "plate": json.dumps(describe(experiment.plate)),
        "plate_height": float(experiment.plate_height),
        "inputs_sha256": inputs_hash(experiment=experiment, load=solution.load),
    }
