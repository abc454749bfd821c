"""Execute every notebook from top to bottom; git keeps them without outputs."""

import concurrent.futures
import os
import pathlib
import sys
import time

import nbclient
import nbformat

HERE = pathlib.Path(__file__).parent
TARGET = HERE.parent / "outputs" / "notebooks"


def execute(path: pathlib.Path) -> bool:
    """Run one, in a kernel of its own; the executed copy with its figures goes to outputs/."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code" and (cell.outputs or cell.execution_count):
            print(f"{path.name} holds outputs: strip them before committing", flush=True)
            return False
    start = time.perf_counter()
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": HERE}}).execute()
    nbformat.write(notebook, TARGET / path.name)
    print(f"{path.name}: {time.perf_counter() - start:.1f} s", flush=True)
    return True


def main() -> int:
    """Run the notebooks beside this file, one on each core."""
    TARGET.mkdir(parents=True, exist_ok=True)
    with concurrent.futures.ThreadPoolExecutor(os.cpu_count()) as pool:
        return int(not all(list(pool.map(execute, sorted(HERE.glob("*.ipynb"))))))


if __name__ == "__main__":
    sys.exit(main())
