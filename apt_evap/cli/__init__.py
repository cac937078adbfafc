"""The command line `apt-evap`: one module for each command."""
