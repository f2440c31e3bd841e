"""Measurements. Many need packages of the extra `dev`; one that is missing is named without a traceback."""

import sys
from types import TracebackType


def explain(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """Print what ends a measurement, as `sys.excepthook`."""
    if isinstance(error, ModuleNotFoundError) and error.name is not None:
        what = f"this measurement needs the package {error.name}, which is not installed"
        print(f"{what}; to install it: pip install -c constraints.txt -e '.[dev]'", file=sys.stderr)
    else:
        sys.__excepthook__(kind, error, traceback)


if "pytest" not in sys.modules:
    sys.excepthook = explain
