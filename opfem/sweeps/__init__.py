"""Parameter sweeps: a function at many points, as one labelled table."""

from .cluster import Cluster as Cluster
from .design import Points as Points, sample as sample, zip_ as zip_
from .execution import Batch as Batch, Devices as Devices
from .sensitivities import value_and_sensitivities as value_and_sensitivities
from .sweep import sweep as sweep
