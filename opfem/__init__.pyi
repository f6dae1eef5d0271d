"""The public names and the modules that hold them; read by `__init__.py`, type checkers and editors."""

from . import datasets as datasets
from .compilation import cache_compilation as cache_compilation
from .decks import (
    Deck as Deck,
    DeckError as DeckError,
    read_dat as read_dat,
    read_frd as read_frd,
    read_inp as read_inp,
    write_inp as write_inp,
)
from .inverse import (
    AxialDisplacement as AxialDisplacement,
    FitError as FitError,
    FitStatus as FitStatus,
    ForceReading as ForceReading,
    LinearEstimate as LinearEstimate,
    LogNormal as LogNormal,
    Matern as Matern,
    Normal as Normal,
    Tikhonov as Tikhonov,
    TotalVariation as TotalVariation,
    TractionFit as TractionFit,
    fit_traction as fit_traction,
    linear_estimate as linear_estimate,
    mesh_error as mesh_error,
    refitted as refitted,
    uniaxial_estimate as uniaxial_estimate,
)
from .io import (
    Checkpoint as Checkpoint,
    read_netcdf as read_netcdf,
    read_oct as read_oct,
    read_spectra as read_spectra,
    read_thickness as read_thickness,
    write_netcdf as write_netcdf,
    write_oct as write_oct,
    write_pvd as write_pvd,
    write_thickness as write_thickness,
    write_vtu as write_vtu,
)
from .measurement import (
    MeasurementError as MeasurementError,
    MeasurementWarning as MeasurementWarning,
    ThicknessMap as ThicknessMap,
)
from .measurement.oct import (
    EDGES as EDGES,
    LAYER as LAYER,
    SAMPLE as SAMPLE,
    SCATTERING_LAYER as SCATTERING_LAYER,
    UWA_845NM as UWA_845NM,
    Interface as Interface,
    Medium as Medium,
    OctSystem as OctSystem,
    OctVolume as OctVolume,
    Spectra as Spectra,
    find_interface as find_interface,
    simulate_oct as simulate_oct,
    thickness_from_oct as thickness_from_oct,
)
from .model import (
    Bonded as Bonded,
    Box as Box,
    Compression as Compression,
    Contact as Contact,
    Cylinder as Cylinder,
    Displacement as Displacement,
    Experiment as Experiment,
    ExponentialOverclosure as ExponentialOverclosure,
    HalfSpace as HalfSpace,
    HardOverclosure as HardOverclosure,
    Hencky as Hencky,
    Imprint as Imprint,
    Layer as Layer,
    LinearOverclosure as LinearOverclosure,
    MooneyRivlin as MooneyRivlin,
    NeoHooke as NeoHooke,
    Ogden as Ogden,
    Palpation as Palpation,
    Roller as Roller,
    Sample as Sample,
    Sphere as Sphere,
    TabularOverclosure as TabularOverclosure,
    Traction as Traction,
    Yeoh as Yeoh,
)
from .plot import (
    plot_comparison as plot_comparison,
    plot_fit as plot_fit,
    plot_interface as plot_interface,
    plot_layer as plot_layer,
    plot_pressure as plot_pressure,
    plot_report as plot_report,
    plot_residual as plot_residual,
    plot_section as plot_section,
    plot_status as plot_status,
    plot_thickness as plot_thickness,
    plot_uncertainty as plot_uncertainty,
)
from .results import (
    Comparison as Comparison,
    OctScene as OctScene,
    compare as compare,
    layer_fields as layer_fields,
    measured_thickness as measured_thickness,
    oct_scene as oct_scene,
    sample_fields as sample_fields,
    summary as summary,
    to_xarray as to_xarray,
)
from .solvers import (
    RESULTS as RESULTS,
    ConvergenceError as ConvergenceError,
    ExperimentSolution as ExperimentSolution,
    Explicit as Explicit,
    Newton as Newton,
    Solution as Solution,
    compiler_options as compiler_options,
    solve as solve,
)
from .sweeps import (
    Batch as Batch,
    Cluster as Cluster,
    Devices as Devices,
    sample as sample,
    sweep as sweep,
    value_and_sensitivities as value_and_sensitivities,
    zip_ as zip_,
)

__version__: str
