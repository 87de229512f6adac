"""`python -m analytic_rasterizer`."""

import sys

from .cli import main

sys.exit(main())
