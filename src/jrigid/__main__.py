"""`python -m jrigid`."""

import sys

from jrigid._cli import main

sys.exit(main())
