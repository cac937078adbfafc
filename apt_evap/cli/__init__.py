"""The command line `apt-evap`: one module per command, with its arguments."""
