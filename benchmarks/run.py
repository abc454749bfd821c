"""Run every benchmark of this folder, one after the other."""

import pathlib
import subprocess
import sys

if __name__ == "__main__":
    for script in sorted(pathlib.Path(__file__).parent.glob("bench_*.py")):
        print(f"\n== {script.stem}", flush=True)
        subprocess.run([sys.executable, str(script), *sys.argv[1:]], check=True)
