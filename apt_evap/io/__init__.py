"""File formats of ions: one module per format; `formats` lists them and contains `read`, `write` and `chunks`."""
