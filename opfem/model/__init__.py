"""The experiment's parts: layer, material, contact, surface, mesh, loads."""

from .contact import Bonded as Bonded, Contact as Contact, Roller as Roller, Side as Side
from .experiment import Experiment as Experiment
from .inclusion import (
    AbstractInclusion as AbstractInclusion,
    Box as Box,
    Cylinder as Cylinder,
    HalfSpace as HalfSpace,
    Sphere as Sphere,
)
from .layer import Layer as Layer
from .load import (
    Compression as Compression,
    Displacement as Displacement,
    Imprint as Imprint,
    Load as Load,
    Traction as Traction,
)
from .material import (
    AbstractMaterial as AbstractMaterial,
    MooneyRivlin as MooneyRivlin,
    NeoHooke as NeoHooke,
    Yeoh as Yeoh,
)
from .mesh import AbstractBlockMesh as AbstractBlockMesh, BlockMesh as BlockMesh, LayerMesh as LayerMesh
from .overclosure import (
    AbstractOverclosure as AbstractOverclosure,
    ExponentialOverclosure as ExponentialOverclosure,
    HardOverclosure as HardOverclosure,
    LinearOverclosure as LinearOverclosure,
    TabularOverclosure as TabularOverclosure,
)
from .palpation import Palpation as Palpation
from .sample import Sample as Sample
from .stability import (
    extreme_stretches as extreme_stretches,
    stable_stretches as stable_stretches,
    unstable_stretch as unstable_stretch,
)
from .stretch_material import Hencky as Hencky, Ogden as Ogden
from .surface import HeightField as HeightField, height_field as height_field
