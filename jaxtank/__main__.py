"""`python -m jaxtank` is the command `jaxtank`: the only import of `tuning` in this package."""

import sys

from tuning.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
