"""The command line as tests call it."""

import pytest

from opfem import cli


def opfem(*arguments) -> int:
    """Run the command line and return its exit status."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return end.value.code
