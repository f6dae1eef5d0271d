"""The one exception that reading a measurement raises, whatever went wrong underneath."""


class MeasurementError(ValueError):
    """A measured file is missing, damaged, ambiguous, or holds something else than a map."""
