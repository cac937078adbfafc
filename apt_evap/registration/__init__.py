"""Bringing two detector maps into register: rotation, scale, shift and mirror."""
