"""The one exception that reading a measurement raises, whatever went wrong underneath, and its one warning."""


class MeasurementError(ValueError):
    """A measured file is missing, damaged, ambiguous, or contains no map."""


class MeasurementWarning(UserWarning):
    """Something in a measured file is odd, and it was read all the same."""
