"""The program apt-evap: outside of the package, so that Ctrl-C is caught while that is being imported."""

import sys


def main() -> int:
    """Run the command line; return its exit code."""
    try:
        from apt_evap.cli import main as run

        return run()
    except KeyboardInterrupt:
        print("apt-evap: interrupted", file=sys.stderr)
        return 130  # 128 + SIGINT
