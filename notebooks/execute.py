"""Execute every notebook from top to bottom; git keeps them without outputs."""

import concurrent.futures
import os
import pathlib
import sys
import time

import nbclient
import nbformat

HERE = pathlib.Path(__file__).parent
# The set-up of tests makes XLA's code generator quicker, here for the kernels.
sys.path.insert(0, str(HERE.parent))
import conftest  # noqa: F401

TARGET = HERE.parent / "outputs" / "notebooks"
FIGURES = {"MPLBACKEND": "module://matplotlib_inline.backend_inline"}  # into the executed copy


def is_executed(path: pathlib.Path) -> bool:
    """Whether outputs/ holds a copy of this one, as it is now."""
    copy = TARGET / path.name
    if not copy.exists():
        return False
    cells = [nbformat.read(x, as_version=4).cells for x in (path, copy)]
    here, there = ([x.source for x in notebook] for notebook in cells)
    return here == there


def execute(path: pathlib.Path) -> bool:
    """Run one, in a kernel of its own; the executed copy with its figures goes to outputs/."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code" and (cell.outputs or cell.execution_count):
            print(f"{path.name} holds outputs: strip them before committing", flush=True)
            return False
    start = time.perf_counter()
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": HERE}})
    client.execute(env={**os.environ, **FIGURES})
    nbformat.write(notebook, TARGET / path.name)
    print(f"{path.name}: {time.perf_counter() - start:.1f} s", flush=True)
    return True


def main() -> int:
    """Run the notebooks beside this file, one on each core; with --new those not run yet."""
    TARGET.mkdir(parents=True, exist_ok=True)
    wanted = [
        x for x in sorted(HERE.glob("*.ipynb")) if "--new" not in sys.argv or not is_executed(x)
    ]
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        return int(not all(list(pool.map(execute, wanted))))


if __name__ == "__main__":
    sys.exit(main())
