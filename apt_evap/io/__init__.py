"""Files of ions: one module per format, and in `formats` the table of them with `read`, `write` and `chunks`."""
