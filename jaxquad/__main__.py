"""`python -m jaxquad` is the command line `jaxquad`."""

import sys

from jaxquad.cli import main


sys.exit(main())
