"""`python -m jaxtank` is the command `jaxtank`: the one door in this package that looks up to `tuning`."""

import sys

from tuning.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
