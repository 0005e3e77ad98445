"""`python -m crazyem`."""

import sys

from crazyem.cli import main

if __name__ == "__main__":
    sys.exit(main())
