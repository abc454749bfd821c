"""Packages that are imported where they are used."""

import importlib
from typing import Any


def extra(name: str) -> Any:
    """A package of the extra `io`, or an error that names it."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        raise ImportError(f'This needs {package}: pip install "jrigid[io]".') from error
