"""The built wheel where nothing else is installed: README and every recipe,
as they stand.

python tests/wheel.py                     # any Python from 3.11 on; needs the network
"""

import re
import struct
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^```py(?:thon)?\n(.*?)^```", re.DOTALL | re.MULTILINE)
RECIPES = ROOT / "docs" / "recipes"
EXTRAS = "demo,records,dask,io"
OTHERS = ["blackjax>=1.2"]  # what a recipe tells to install beside
# What needs each extra, and a word of the error without it.
MISSING = (
    ("plot", "jr.plot.polhode(np.array([1.0, 2.0, 3.0]))"),
    ("io", "jr.io.to_jaxlie(np.array([1.0, 0.0, 0.0, 0.0]))"),
    ("io", "jr.io.read_mesh('part.stl')"),
    ("sweep", "jr.sweep(lambda x: x, {'x': np.arange(3.0)}, store='map.zarr')"),
    ("records", "jr.records.read('flight.bbl')"),
    ("data", "jr.datasets.earth_pole()"),
)
# A cluster of this machine's own, in the place of a queue's.
CLUSTER = """
from distributed import LocalCluster
class SLURMCluster(LocalCluster):
    def __init__(self, **_):
        super().__init__(n_workers=2, threads_per_worker=1, dashboard_address=None)
    def scale(self, jobs): ...
"""


def main() -> int:
    """Build, install, run; the number of what failed."""
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        venv.create(here / "env", with_pip=True)
        python = here / "env" / "bin" / "python"
        pip = [
            python,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--constraint",
            ROOT / "constraints.txt",
        ]
        build = [
            python,
            "-m",
            "pip",
            "wheel",
            "--quiet",
            "--no-deps",
            "--wheel-dir",
            here,
            ROOT,
        ]
        subprocess.run(build, check=True)
        wheel = next(here.glob("jrigid-*.whl"))
        subprocess.run([*pip, wheel], check=True)
        print(
            sys.version.split()[0], wheel.name, f"{wheel.stat().st_size / 1e3:.0f} kB"
        )
        (here / "flight.bbl").write_text(
            "H Product:Blackbox flight data recorder by Nicholas Sherlock"
        )
        failed = [name for name, call in MISSING if not names(python, here, name, call)]
        subprocess.run([*pip, f"{wheel}[{EXTRAS}]", *OTHERS], check=True)
        (here / "part.stl").write_bytes(box())
        (here / "dask_jobqueue.py").write_text(CLUSTER)
        pages = [
            ROOT / "README.md",
            ROOT / "docs" / "getting_started.md",
            *RECIPES.glob("*.md"),
        ]
        failed += [page.stem for page in pages if not runs(python, here, page)]
        print("failed:", *failed or ["nothing"])
        return len(failed)


def names(python: Path, here: Path, group: str, call: str) -> bool:
    """Whether the error of a call says which extra is missing."""
    code = f"import numpy as np, jrigid as jr\n{call}"
    done = subprocess.run(
        [python, "-c", code], cwd=here, capture_output=True, text=True
    )
    last = done.stderr.strip().splitlines()[-1] if done.returncode else "no error"
    print(f"without {group}:", last)
    return "ImportError" in last and f'pip install "jrigid[{group}]"' in last


def runs(python: Path, here: Path, page: Path) -> bool:
    """Whether the blocks of a page run one after the other;
    a sweep of a day only has to begin."""
    usual = BLOCK.search((RECIPES / "index.md").read_text())[1]
    script = here / f"page_{page.stem}.py"  # no name that one imports
    script.write_text(usual + "".join(BLOCK.findall(page.read_text())))
    start = time.perf_counter()
    try:
        command = [python, "-W", "error::DeprecationWarning:__main__", script]
        done = subprocess.run(
            command, cwd=here, capture_output=True, text=True, timeout=300
        )
        good, last = done.returncode == 0, done.stderr[-2000:]
    except subprocess.TimeoutExpired:
        subprocess.run(["pkill", "-f", str(here / "env")], check=False)
        good, last = any((here / "chaos.zarr").glob("valid/c/*/*")), "took too long"
    print(
        f"{page.stem}: {time.perf_counter() - start:.0f} s",
        "" if good else "FAILED\n" + last,
    )
    return good


def box() -> bytes:
    """An STL file of a box, 240 x 170 x 30 mm; every triangle has its own corners,
    as they have."""
    corners = [(x, y, z) for x in (0, 240) for y in (0, 170) for z in (0, 30)]
    sides = [
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    ]
    faces = [x for a, b, c, d in sides for x in ((a, b, c), (a, c, d))]
    rows = [
        struct.pack("<12fH", 0, 0, 0, *(x for i in f for x in corners[i]), 0)
        for f in faces
    ]
    return bytes(80) + struct.pack("<I", len(faces)) + b"".join(rows)


if __name__ == "__main__":
    sys.exit(main())
