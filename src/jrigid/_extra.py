"""Packages of the extras, imported where they are used."""

import importlib
from typing import Any


def extra(group: str, module: str) -> Any:
    """A module of a package of an extra, or an error that names both."""
    package = module.partition(".")[0]
    try:
        importlib.import_module(package)
        return importlib.import_module(module)
    except ImportError as error:
        package = package.replace("_", "-")
        raise ImportError(
            f'This needs {package}: pip install "jrigid[{group}]".'
        ) from error
