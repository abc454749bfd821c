"""Names that `dir`, `help` and star imports of a module show."""

import inspect
import sys


def list_public_names(name: str) -> None:
    """Give a module an `__all__`, and a `dir`, of its public names alone.

    Of a package these are what its `__init__` imports without an underscore; of a plain
    module what is defined in it. It is the last statement of the module.
    """
    module = sys.modules[name]
    package = hasattr(module, "__path__")
    names = [
        name
        for name, value in sorted(vars(module).items())
        if not name.startswith("_") and not inspect.ismodule(value)
        if package or getattr(value, "__module__", None) == module.__name__
    ]
    vars(module).update(__all__=names, __dir__=lambda: names)
