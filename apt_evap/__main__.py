"""`python -m apt_evap`: the command line for a certain Python, as in the jobs of a batch system."""

import sys

from apt_evap.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
