"""Execute every notebook from top to bottom; git keeps them without outputs."""

import pathlib
import sys
import time

import nbclient
import nbformat


def main() -> int:
    """Run the notebooks beside this file; executed copies with their figures go to outputs/."""
    here = pathlib.Path(__file__).parent
    target = here.parent / "outputs" / "notebooks"
    target.mkdir(parents=True, exist_ok=True)
    for path in sorted(here.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        for cell in notebook.cells:
            if cell.cell_type == "code" and (cell.outputs or cell.execution_count):
                print(f"{path.name} holds outputs: strip them before committing")
                return 1
        start = time.perf_counter()
        client = nbclient.NotebookClient(
            notebook, timeout=600, resources={"metadata": {"path": here}}
        )
        client.execute()
        nbformat.write(notebook, target / path.name)
        print(f"{path.name}: {time.perf_counter() - start:.1f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
