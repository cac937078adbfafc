"""Flights of the ions to the detector, and the response of each ion to its launch velocity."""
