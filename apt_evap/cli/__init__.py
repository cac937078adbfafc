"""The command line `apt-evap`: one module for each command, what all of them take in `parser`."""
