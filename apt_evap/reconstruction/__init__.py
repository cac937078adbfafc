"""Positions of the ions in the specimen from their hits, calibration, and errors against the true sites."""
