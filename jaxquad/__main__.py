"""`python -m jaxquad` is the command line `jaxquad`."""

import sys


try:
    from jaxquad.cli import main
except KeyboardInterrupt:
    print("jaxquad: interrupted", file=sys.stderr)
    sys.exit(130)


if __name__ == "__main__":
    sys.exit(main())
