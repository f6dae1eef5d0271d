"""The experiment's parts: layer, material, contact, surface, mesh, loads."""

from .contact import Bonded as Bonded, Contact as Contact, Roller as Roller, Side as Side
from .layer import Layer as Layer
from .load import Displacement as Displacement, Imprint as Imprint, Load as Load, Traction as Traction
from .material import (
    AbstractMaterial as AbstractMaterial,
    MooneyRivlin as MooneyRivlin,
    NeoHooke as NeoHooke,
    Yeoh as Yeoh,
)
from .mesh import LayerMesh as LayerMesh
from .overclosure import (
    AbstractOverclosure as AbstractOverclosure,
    ExponentialOverclosure as ExponentialOverclosure,
    HardOverclosure as HardOverclosure,
    LinearOverclosure as LinearOverclosure,
    TabularOverclosure as TabularOverclosure,
)
from .palpation import Palpation as Palpation
from .stability import extreme_stretches as extreme_stretches, unstable_stretch as unstable_stretch
from .stretch_material import Hencky as Hencky, Ogden as Ogden
from .surface import HeightField as HeightField, height_field as height_field
