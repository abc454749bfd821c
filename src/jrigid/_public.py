"""What `dir`, `help` and star imports of a module show."""

import inspect
from types import ModuleType


def list_public_names(*modules: ModuleType) -> None:
    """Give modules an `__all__`, and a `dir`, of their public names alone.

    Of a package these are what its `__init__` imports without an underscore; of a plain
    module what is defined in it.
    """
    for module in modules:
        package = hasattr(module, "__path__")
        names = [
            name
            for name, value in sorted(vars(module).items())
            if not name.startswith("_") and not inspect.ismodule(value)
            if package or getattr(value, "__module__", None) == module.__name__
        ]
        vars(module).update(__all__=names, __dir__=lambda names=names: names)
