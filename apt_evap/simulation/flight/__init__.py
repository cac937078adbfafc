"""Threads that compute the flights, detector hits, and responses of the ions to their launch velocities."""
