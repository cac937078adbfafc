"""Flights of the ions: their threads, detector hits, and responses to the launch velocities."""
