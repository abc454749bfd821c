"""Demonstration: inertia from an observed wobble, synthetic and real.

Run it: `python demo.py [picture.png]`, or `make demo`.
"""

import sys
import time
from pathlib import Path

import earth_wobble
import jax
import symmetric_top


def main() -> None:
    """Fit a body whose inertia is known, then the Earth."""
    begin = time.perf_counter()
    jax.config.update("jax_enable_x64", True)
    symmetric_top.main()
    print()
    earth_wobble.main(Path(sys.argv[1]) if len(sys.argv) > 1 else earth_wobble.PICTURE)
    print(f"{time.perf_counter() - begin:.0f} s, compilation included")


if __name__ == "__main__":
    main()
