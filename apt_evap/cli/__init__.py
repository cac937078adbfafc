"""The command line `apt-evap`: one module per command; all arguments are defined in `parser`."""
